"""The validation pages of the documentation, a module for each system."""
