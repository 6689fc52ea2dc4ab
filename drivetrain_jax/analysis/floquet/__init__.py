"""Floquet stability: propagators, multipliers with their bound, verdicts, derivatives, the tip of a tongue."""
