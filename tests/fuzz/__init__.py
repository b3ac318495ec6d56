"""Odd configs and outline files, made from a seed; `make fuzz` tries thousands of them."""
