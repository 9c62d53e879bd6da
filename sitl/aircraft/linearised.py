"""A nonlinear aircraft near one trimmed condition: what goes into a model file, before it is held at Ts.

The longitudinal motion at constant speed, Eq. (2), in deviations from trim: x = [alpha, q, theta], one input, the
elevator, and one disturbance, a gust as a rate of alpha. What else the aircraft can do was left out by whoever made it.
"""

from __future__ import annotations

from dataclasses import dataclass

from gains.model import Matrix

__all__ = ["STATES", "Linearised"]

STATES = ("alpha_rad", "q_rad_s", "theta_rad")


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """x'(t) = Ap x + Bp u + Ep w around a trim.

    Attributes
    ----------
    aircraft : str
        As ``--plant`` names it: ``sixdof:hirm``, ``jsbsim:c172x``.
    Ap : ndarray, shape (3, 3)
    Bp, Ep : ndarray, shape (3, 1)
        Per second; angles in rad, u in its own unit, w in rad/s.
    alpha_rad, theta_rad, u : float
        Trim.
    u_low, u_high : float
        Travel of the elevator, absolute.
    u_rate, u_tau : float or None
        Its fastest motion, per second, and its lag, s; None where it has none.
    u_unit : str
        ``rad`` or ``norm``, JSBSim's command from -1 to 1.
    airspeed_m_s, altitude_m : float
        True airspeed and altitude of the trim, level flight.
    throttle : float
        Of the trim, 0 to 1.
    notes : tuple of str
        Lines for people: where it comes from, what was left out and how much that is.
    """

    aircraft: str
    Ap: Matrix
    Bp: Matrix
    Ep: Matrix
    alpha_rad: float
    theta_rad: float
    u: float
    u_low: float
    u_high: float
    u_rate: float | None
    u_tau: float | None
    u_unit: str
    airspeed_m_s: float
    altitude_m: float
    throttle: float
    notes: tuple[str, ...] = ()
