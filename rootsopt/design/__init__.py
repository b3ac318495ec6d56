"""The design space: bounds of the parameters, the unit box they span, constraints."""
