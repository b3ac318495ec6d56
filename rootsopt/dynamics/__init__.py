"""Motion of a rotor pair: equation, integration, orbits and their derivatives."""
