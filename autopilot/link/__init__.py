"""What both ends of the link share: nodes, clocks, frames, drivers and recordings."""
