"""The laboratory: people who are perturbed, and what is recorded of them."""
