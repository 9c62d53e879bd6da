"""Seeds: everything random in a flight comes from one."""

from __future__ import annotations

__all__ = ["MAX_SEED"]

MAX_SEED = 2**63 - 1
"""Largest seed: it fits the integers of a summary."""
