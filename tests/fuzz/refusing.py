"""What every target has in common: it takes bytes, and says whether they meant something or were refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

Run = Callable[[bytes], bool]
"""True where the input was taken, False where it was refused as documented; what is raised is a defect."""


def refusing(*documented: type[Exception]) -> Callable[[Callable[[bytes], None]], Run]:
    """Make a target of a function that may raise only these."""

    def decorate(body: Callable[[bytes], None]) -> Run:
        @wraps(body)
        def run(data: bytes) -> bool:
            try:
                body(data)
            except documented:
                return False
            return True

        return run

    return decorate
