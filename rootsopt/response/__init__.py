"""Response of a design in a scene: forces, their derivatives, and a status that qualifies them."""
