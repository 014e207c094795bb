"""Human-arm perturbation experiments on synthetic people in MuJoCo, and their analysis."""
