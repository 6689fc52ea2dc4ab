"""Constants of a system in closed form."""
