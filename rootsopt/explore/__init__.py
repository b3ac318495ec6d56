"""The explorer: a local page whose sliders move a design and its scene; the forces follow."""
