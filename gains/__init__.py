"""Gains: design and proof of the control gains, offline. Imports neither of the other two programs."""
