"""Response of a design in a scene: forces, their derivatives, and how far to trust them."""
