"""The motion of a rotor pair: equation, integration, orbits and their derivatives."""
