"""Linear periodic systems: propagators, multipliers with their bound, forced orbits."""
