"""What recordings tell, per person and per trial."""
