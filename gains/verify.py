"""Certificates re-checked from their stored matrices, by eigenvalues in double precision; NumPy only.

Nothing here comes from the modules that made the certificate: the inequality of Lemma 1 is assembled again, by
its own formula, from the model, the gains and P, Q, R, μ, η. A matrix passes when its smallest eigenvalue
exceeds a bound on everything that rounding can have changed. Before that it is brought to a diagonal near 1 by
powers of two, which rounds nothing and makes margin and bound independent of units.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from gains.certificate import MAX_DELAY, Certificate, read_certificate
from gains.definite import EPS, LEAST, MOST, UNDERFLOW, Verification, definite, failed
from gains.model import GainLaw, Gains, Matrix, Schedule
from gains.switched_certificate import SwitchedCertificate, read_switched
from gains.verify_switched import check_switched

__all__ = ["Verification", "check", "least_eta", "verified"]


@lru_cache(maxsize=64)  # gains never change, and a schedule may take many seconds
def verified(gains: GainLaw) -> Verification:
    """Return whether the certificate in a gain file proves its whole window of delays.

    Raises
    ------
    InputError
        When a field of the certificate is missing or malformed.
    """
    if isinstance(gains, Gains) and gains.controller is not None:
        return failed("no proof speaks of this controller")
    if gains.certificate is None:
        return failed("there is no certificate")
    if gains.certificate.get("method") == SwitchedCertificate.method:
        exact = read_switched(gains)
        return _outside(gains, exact) or check_switched(gains, exact)
    certificate = read_certificate(gains)
    if certificate is None:
        return failed(f"method {gains.certificate.get('method')!r} cannot be verified by this version")
    if isinstance(gains, Schedule):
        return failed(f"a schedule cannot be verified: {certificate.method} certificates speak of one set of gains")
    return _outside(gains, certificate) or check(gains, certificate)


def _outside(gains: GainLaw, certificate: Certificate | SwitchedCertificate) -> Verification | None:
    """Return a failure where the window of the gains is not that of the certificate or inside it."""
    if certificate.d_min <= gains.d_min and gains.d_max <= certificate.d_max:
        return None
    window = f"{gains.d_min} to {gains.d_max}"
    return failed(f"the gains are for delays {window}, the certificate for {certificate.d_min} to {certificate.d_max}")


def check(gains: Gains, certificate: Certificate) -> Verification:
    """Return whether P, Q, R ≻ 0, μ ≥ 0 and the inequality of Lemma 1 holds strictly, robust if delta_max > 0."""
    weights = [certificate.P, certificate.Q, certificate.R]
    unusable = _unusable(gains, certificate)
    if unusable:
        return failed(unusable)
    results: list[Verification] = []
    for name, X in zip(("P", "Q", "R"), weights, strict=True):
        if not np.array_equal(X, X.T):
            return failed(f"{name} is not symmetric")
        results.append(definite(X, np.zeros_like(X), f"{name} is not positive definite"))
    broken = [result for result in results if not result.passed]
    if broken:
        return broken[0]
    beyond = _beyond_reckoning(gains, certificate)
    if beyond:
        return failed(beyond)
    with np.errstate(over="ignore", invalid="ignore"):
        matrix, error = _inequality(gains, certificate)
        results.append(definite(-matrix, error, "the inequality of Lemma 1 does not hold"))
    return min(results, key=lambda v: (v.passed, v.margin / v.rounding if v.rounding > 0.0 else -math.inf))


def _unusable(gains: Gains, certificate: Certificate) -> str:
    """Return why a certificate makes no sense; empty if it does."""
    d_min, d_max, mu, eta = certificate.d_min, certificate.d_max, certificate.mu, certificate.eta
    if not (0 <= d_min <= d_max and 1 <= d_max <= MAX_DELAY):
        return f"no window of delays: {d_min} to {min(d_max, MAX_DELAY + 1)}"
    scalars = np.array([mu, certificate.delta_max, 0.0 if eta is None else eta])
    if not all(np.isfinite(X).all() for X in (certificate.P, certificate.Q, certificate.R, scalars)):
        return "a number is not finite"
    if mu < 0.0 or (eta is not None and eta <= 0.0) or certificate.delta_max < 0.0:
        return "mu, eta or delta_max is out of range"
    if certificate.delta_max > 0.0 and gains.model.uncertainty is None:
        return "it speaks of an uncertainty that the model does not have"
    return ""


def _beyond_reckoning(gains: Gains, certificate: Certificate) -> str:
    """Return why the rounding of what follows could not be bounded; empty if it can."""
    weights = [certificate.P, certificate.Q, certificate.R]
    scalars = [certificate.mu or 1.0, certificate.eta or 1.0, certificate.delta_max or 1.0]
    sizes = np.concatenate([*(np.abs(np.diag(X)) for X in weights), scalars])
    if sizes.min() < LEAST or max(sizes.max(), *(np.abs(X).max() for X in weights)) > MOST:
        return "a number is too small or too large to be computed with"
    if max(np.abs(part).max(initial=0.0) for part in _maps(gains, certificate.delta_max, modulus=True)) > MOST:
        return "a number of the model or the gains is too large to be computed with"
    return ""


def least_eta(gains: Gains, certificate: Certificate) -> float:
    """Return the infimum of the η that P, Q, R, μ prove, by a Schur complement; infinite if none.

    A value for :func:`check`, not a proof; any η in the certificate will do.
    """
    assert certificate.eta is not None
    matrix, _ = _inequality(gains, certificate)
    n, m = 2 * certificate.P.shape[0], _inputs(gains)
    v = slice(n, n + m)
    rest = np.r_[0:n, n + m : matrix.shape[0]]
    base = -matrix[np.ix_(rest, rest)]
    if not np.all(np.diag(base) > 0.0):
        return math.inf
    unit = 1.0 / np.sqrt(np.diag(base))
    try:
        factor = np.linalg.cholesky(base * unit[:, None] * unit[None, :])
    except np.linalg.LinAlgError:
        return math.inf
    cross = np.linalg.solve(factor, matrix[rest, v] * unit[:, None])
    corner = matrix[v, v] + certificate.eta**2 * np.eye(m) + cross.T @ cross
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(corner)[-1])))


def _inputs(gains: Gains) -> int:
    reference = gains.model.reference
    return gains.model.nw + (0 if reference is None else int(reference.Br.shape[1]))


def _inequality(gains: Gains, certificate: Certificate) -> tuple[Matrix, Matrix]:
    """Return the matrix that shall be negative definite and a bound on the error of each entry.

    In x(k), xr(k), x(k−d), xr(k−d), v, p: z⁺'P z⁺ + d_max (z⁺ − z)'R(z⁺ − z) + e'e + μ(|q|² − |p|²) − η²|v|²
    − z'(P − cQ)z − z_d'Q z_d − (z − z_d)'R(z − z_d)/d_max, with z⁺ = A z + A1 z_d + B v + F̄ p and
    q = J̄1 z + J̄2 z_d. Without η: v = 0 and e left out.
    """
    P, Q, R, mu = certificate.P, certificate.Q, certificate.R, certificate.mu
    d, c, n = certificate.d_max, certificate.d_max - certificate.d_min + 1, P.shape[0]
    step, output, right = _maps(gains, certificate.delta_max)
    size = step.shape[1]
    now, past = np.eye(n, size), np.eye(n, size, n)
    m = _inputs(gains)
    corner = np.zeros(size)
    corner[2 * n : 2 * n + m] = 0.0 if certificate.eta is None else certificate.eta**2
    corner[2 * n + m :] = mu
    move, lag = step - now, now - past
    terms = [(P, step), (d * R, move), (mu * np.eye(right.shape[0]), right), (-P, now), (c * Q, now)]
    terms += [(-Q, past), (-R / d, lag)]
    step_, output_, right_ = _maps(gains, certificate.delta_max, modulus=True)
    majorants = [(P, step_), (d * R, step_ + now), (mu * np.eye(right.shape[0]), right_), (P, now), (c * Q, now)]
    majorants += [(Q, past), (R / d, now + past)]
    if certificate.eta is not None:
        terms.append((np.eye(output.shape[0]), output))
        majorants.append((np.eye(output.shape[0]), output_))
    matrix = sum((row.T @ X @ row for X, row in terms), -np.diag(corner))
    bound = sum((row.T @ np.abs(X) @ row for X, row in majorants), np.diag(corner))
    # two inner products over n (or q), one over nu inside the maps, the sum over the terms, with room to spare
    operations = 2 * (n + right.shape[0] + output.shape[0]) + 4 * gains.model.nu + 4 * len(terms)
    keep = np.ones(size, dtype=bool)
    if certificate.eta is None:
        keep[2 * n : 2 * n + m] = False
    matrix = (matrix + matrix.T) / 2
    return matrix[np.ix_(keep, keep)], operations * EPS * bound[np.ix_(keep, keep)] + UNDERFLOW


def _maps(gains: Gains, delta_max: float, *, modulus: bool = False) -> tuple[Matrix, Matrix, Matrix]:
    """Return z⁺, e and q as linear maps of (x, xr, x_d, xr_d, v, p); with ``modulus`` majorants of them."""
    model, reference, uncertainty = gains.model, gains.model.reference, gains.model.uncertainty

    def of(matrix: Matrix) -> Matrix:
        return np.abs(matrix) if modulus else matrix

    nx, nr, nw, m = model.nx, model.nr, model.nw, _inputs(gains)
    n = nx + nr
    p = 0 if uncertainty is None or delta_max == 0.0 else uncertainty.F.shape[1]
    q = 0 if uncertainty is None or delta_max == 0.0 else uncertainty.J1.shape[0]
    x, xr, past, v = slice(0, nx), slice(nx, n), slice(n, n + nx), slice(2 * n, 2 * n + m)
    step = np.zeros((n, 2 * n + m + p))
    output = np.zeros((model.ny, 2 * n + m + p))
    right = np.zeros((q, 2 * n + m + p))
    step[x, x], step[x, past], step[x, v.start : v.start + nw] = of(model.A), of(model.B) @ of(gains.K1), of(model.E)
    output[:, x], output[:, past] = of(model.C), of(model.D) @ of(gains.K1)
    if reference is not None and gains.K2 is not None:
        sign = 1.0 if modulus else -1.0
        step[x, xr], step[xr, xr] = of(model.B) @ of(gains.K2), of(reference.Ar)
        step[xr, v.start + nw : v.stop] = of(reference.Br)
        output[:, xr] = of(model.D) @ of(gains.K2) + sign * of(reference.Cr)
    if p and uncertainty is not None:
        step[x, v.stop :] = delta_max * of(uncertainty.F)
        right[:, x], right[:, past] = of(uncertainty.J1), of(uncertainty.J2) @ of(gains.K1)
        if gains.K2 is not None:
            right[:, xr] = of(uncertainty.J2) @ of(gains.K2)
    return step, output, right
