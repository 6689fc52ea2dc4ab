"""Lyapunov spectra: growth of perturbations, standard errors, measures of sections, verdicts."""
