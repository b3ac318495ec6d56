"""The motion of a rotor pair: equation of motion, integration, periodic orbits and their
derivatives."""
