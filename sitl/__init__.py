"""SITL: the world around the autopilot: aircraft, link, scenarios, recordings."""
