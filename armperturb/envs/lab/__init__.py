"""The laboratory: perturbed people, and what is recorded of them."""
