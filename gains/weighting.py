"""Weights on what the gain is counted from and to: a weighted design is the design of a weighted model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gains.model import Matrix, Model, Reference

__all__ = ["Weighting", "weighted"]


@dataclass(frozen=True, slots=True)
class Weighting:
    """Weights, each a number or one for each entry.

    The design minimises η in ‖[e_weight·e; √effort·u]‖₂ < η ‖[w / w_weight; r / r_weight]‖₂: a larger w or r is an
    input expected larger, a larger e or effort an output wanted smaller.

    Attributes
    ----------
    w, r, e : float or array_like
    effort : float or array_like
        ρ of the control effort, for each input; 0 leaves u out.
    """

    w: ArrayLike = 1.0
    r: ArrayLike = 1.0
    e: ArrayLike = 1.0
    effort: ArrayLike = 0.0


def weighted(model: Model, weighting: Weighting) -> Model:
    """Return the model whose η is the weighted one.

    Its outputs are the weighted e, then √ρ u for each input whose ρ is not 0: rows of D and zero rows of C and Cr.

    Raises
    ------
    ValueError
        When a weight has the wrong length, is negative, or is 0 where only more than 0 makes sense.
    """
    reference = model.reference
    w = _weights("w", weighting.w, model.nw)
    e = _weights("e", weighting.e, model.ny)
    effort = _weights("effort", weighting.effort, model.nu, zero=True)
    rows = np.diag(np.sqrt(effort))[effort > 0.0]
    if reference is not None:
        r = _weights("r", weighting.r, reference.Br.shape[1])
        Cr = np.vstack([e[:, None] * reference.Cr, np.zeros((len(rows), model.nr))])
        reference = Reference(reference.Ar, reference.Br * r, Cr)
    return replace(
        model,
        E=model.E * w,
        C=np.vstack([e[:, None] * model.C, np.zeros((len(rows), model.nx))]),
        D=np.vstack([e[:, None] * model.D, rows]),
        reference=reference,
    )


def _weights(name: str, value: ArrayLike, length: int, *, zero: bool = False) -> Matrix:
    given = np.asarray(value, dtype=np.float64)
    if given.ndim > 1 or (given.ndim == 1 and given.shape != (length,)):
        raise ValueError(f"weight {name}: expected a number or {length} numbers, found shape {given.shape}")
    if not np.all(np.isfinite(given)) or np.any(given < 0.0) or (not zero and np.any(given == 0.0)):
        raise ValueError(f"weight {name}: expected {'nonnegative' if zero else 'positive'} numbers, found {value!r}")
    return np.broadcast_to(given, (length,))
