"""The space of designs: bounds of the parameters, mapping to the unit box, and constraints."""
