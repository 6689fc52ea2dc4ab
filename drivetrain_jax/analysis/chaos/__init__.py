"""Growth of perturbations, Lyapunov exponents, sections and verdicts."""
