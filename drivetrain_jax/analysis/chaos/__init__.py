"""Growth of perturbations, exponents, sections and the kind of motion they tell."""
