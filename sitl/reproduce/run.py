"""A whole reproduction: flights, proofs, slips, claims, in one value that every file is written from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sitl.reproduce.cases import PENDULUM, PUBLISHED
from sitl.reproduce.claims import Claim, Section, Table
from sitl.reproduce.hirm import Hirm, fly_hirm
from sitl.reproduce.hirm_claims import hirm_section, proof_claims
from sitl.reproduce.pendulum import Bounds, Pendulum, bounds_of, delays_table, fly_pendulum, pendulum_section
from sitl.reproduce.proofs import Proofs, eta_table, feasibility_table, prove
from sitl.reproduce.slips import slips

__all__ = ["STEPS", "Reproduction", "reproduce"]

STEPS = 30
"""About how many things are told of in a run, for a bar of progress."""
_EXACT_PENDULUM = "pendulum-exact-paper"


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """What a run came to.

    Attributes
    ----------
    seed : int
        Of d(k) and of the flights.
    quick : bool
    pendulum : Pendulum
    hirm : Hirm
    sections : tuple of Section
        Of the page, in its order; they hold all tables and claims.
    skipped : tuple of str
        What a quick run left out.
    """

    seed: int
    quick: bool
    pendulum: Pendulum
    hirm: Hirm
    sections: tuple[Section, ...]
    skipped: tuple[str, ...]

    @property
    def claims(self) -> tuple[Claim, ...]:
        """All claims, in the order of the page."""
        return tuple(claim for section in self.sections for claim in section.claims)

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables, in the order of the page."""
        return tuple(table for section in self.sections for table in section.tables)


def reproduce(seed: int, tell: Callable[[str], None], *, quick: bool = False) -> Reproduction:
    """Fly, prove and judge everything; equal seeds give equal numbers.

    Parameters
    ----------
    seed : int
        Of d(k) and of the flights.
    tell : callable
        Called with a line before each step.
    quick : bool
        Leave out what is slow: flights with pulses, most of the other delay sequences, lower bounds of η, a design.
    """
    pendulum = fly_pendulum(seed, tell)
    tell("the largest delays of the other gains")
    bounds = (pendulum.bounds, bounds_of(_EXACT_PENDULUM), bounds_of(PUBLISHED))
    hirm = fly_hirm(seed, tell, quick=quick)
    proofs = prove(tell, quick=quick)
    tell("slips")
    sections = (
        pendulum_section(pendulum),
        hirm_section(hirm, proofs),
        _proofs_section(bounds, proofs),
        Section(
            "Slips and readings",
            ("What the printed paper has wrong or leaves open, each with a computation that anyone can repeat.",),
            claims=slips(hirm, proofs, seed),
        ),
    )
    skipped = (*proofs.skipped, "flights with pulses", "most of the other delay sequences") if quick else ()
    return Reproduction(seed, quick, pendulum, hirm, sections, skipped)


def _proofs_section(bounds: tuple[Bounds, ...], proofs: Proofs) -> Section:
    assert bounds[0].gains.name == PENDULUM
    return Section(
        "What is proved",
        (
            "Everything here is computed in the run; a solver only proposes, and each proof is checked again from its"
            " matrices.",
        ),
        tables=(delays_table(bounds), eta_table(proofs), feasibility_table(proofs)),
        claims=proof_claims(proofs),
    )
