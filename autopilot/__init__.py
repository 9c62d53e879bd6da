"""Autopilot: flies the gains over MAVLink, whatever the link does to the messages."""
