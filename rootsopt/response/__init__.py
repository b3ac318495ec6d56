"""What a design comes to in a scene: forces, their derivatives, and how far they can be trusted."""
