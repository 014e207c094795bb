"""Recordings of laboratories: read, checked against physics, repaired as asked, and written for other programs."""
