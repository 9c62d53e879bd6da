"""Many flights at once: what a claim such as "safe for d in [1, 6]" is worth, beside its proof.

``distributions.py`` says from what a flight is drawn, ``job.py`` what a campaign is. ``philox.py``, ``signals.py`` and
``kernel.py`` are compiled: random numbers by (seed, flight number), what the flight meets, and the loop itself;
``engine.py`` flies ranges of flights with them. numba is imported there and nowhere else.
"""
