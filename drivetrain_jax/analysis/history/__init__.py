"""Time histories."""
