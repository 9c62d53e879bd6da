"""The vehicle as ground stations see and command it."""
