"""The design space: bounds of the parameters, the unit box that they define, and constraints."""
