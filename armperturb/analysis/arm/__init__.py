"""Models of the arm: geometry, linear admittance, state space."""
