"""Identification of a single joint, or of a single direction: intrinsic and reflex path side by side."""
