"""The link between aircraft and autopilot: what it does to packets, as text, as pure models, and as a Node."""
