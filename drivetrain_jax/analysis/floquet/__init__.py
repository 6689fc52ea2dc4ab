"""Floquet stability: propagators, multipliers with their bound, verdicts, derivatives."""
