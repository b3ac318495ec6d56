"""The design space: bounds, the unit box, constraints."""
