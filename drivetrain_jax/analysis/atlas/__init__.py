"""The stability atlas as an analysis: its solves."""
