"""The commands that prove and design: ``gains certify``, ``gains bound``, ``gains design``; dispatch by method.

What needs a solver is imported by the command that does, so that listing and showing stay quick.
"""

from __future__ import annotations

import re
import time
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gains.command import NEGATIVE, SUCCESS, FiniteRange, print_json, require_writable, version
from gains.gainfile import check_conservative
from gains.model import GainLaw, Gains, Schedule
from gains.store import DELAY_LIMIT, load_gains, load_law, model_path, require_law, save_gains
from gains.table import InputError

if TYPE_CHECKING:
    from gains.decide import Decision
    from gains.exact import ExactAnalysis
    from gains.lyapunov import Analysis
    from gains.switched import Transitions

__all__ = [
    "JSON_OPTION",
    "PLOT_OPTION",
    "TRANSITIONS_OPTION",
    "bound",
    "certify",
    "design",
    "parse_window",
    "schedule",
    "witness",
    "writable",
    "write_certified",
]

JSON_OPTION = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
TRANSITIONS_OPTION = click.option(
    "--transitions", type=click.Choice(["any", "fifo"]), default="any", show_default=True, help="How delays may change."
)
_clock = time.perf_counter  # noqa: TID251  # a command says how long it took


def writable(_context: click.Context, _option: click.Parameter, path: Path | None) -> Path | None:
    """Refuse a file that cannot be written before anything is computed."""
    if path is not None:
        require_writable(path)
    return path


def drawable(context: click.Context, option: click.Parameter, plot: Path | None) -> Path | None:
    """Refuse a plot that cannot be written, or in an unknown format, before anything is computed."""
    if plot is not None:
        from gains.plot import require_format  # with the plotting library: most commands do without

        require_format(plot)
    return writable(context, option, plot)


GAIN_FILE_OPTION = click.option(
    "-o", "--output", type=click.Path(path_type=Path), callback=writable, required=True, help="The gain file."
)
PLOT_OPTION = click.option(
    "--plot",
    type=click.Path(path_type=Path),
    callback=drawable,
    metavar="FILE",
    help="Draw the answer: a .png, .svg or .pdf file.",
)


@click.command()
@click.argument("name", metavar="GAINS")
@click.option("--delay", "delay", metavar="MIN:MAX", help="Window of delays in samples; default: the file's.")
@click.option("--method", type=click.Choice(["exact", "lyapunov", "printed"]), default="exact", show_default=True)
@TRANSITIONS_OPTION
@click.option("--delta", type=FiniteRange(min=0.0), default=0.0, help="Bound on the uncertainty; default 0: none.")
@click.option("--memory", type=click.IntRange(0, 2), default=0, show_default=True, help="Past delays a storage knows.")
@click.option("--flown/--no-flown", default=True, show_default=True, help="Certify the law as it runs too.")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), callback=writable, help="Write the gains with their certificate."
)
@JSON_OPTION
def certify(
    name: str,
    delay: str | None,
    method: str,
    transitions: Transitions,
    delta: float,
    memory: int,
    flown: bool,
    output: Path | None,
    as_json: bool,
) -> int:
    """Prove that GAINS are stable for every delay in a window, and bound the gain eta from v to e.

    'exact' decides on the lifted form: a proof and eta with a delay sequence that comes near it, or a delay sequence
    that breaks the loop; --memory tightens eta. 'lyapunov' is Lemma 1, 'printed' is Lemma 2 and Theorem 1 as the
    paper prints them: sufficient, without a proof the answer is 'undecided'. A proof for transitions 'any' holds for
    'fifo' too.
    """
    law = require_law(load_law(name))
    d_min, d_max = (law.d_min, law.d_max) if delay is None else parse_window(delay)
    if delta > 0.0 and law.model.uncertainty is None:
        raise InputError(f"--delta: expected 0, as model {law.model.name} has no [uncertainty], found {delta:g}")
    if isinstance(law, Schedule) and not (d_min <= law.d_min and law.d_max <= d_max):
        raise InputError(
            f"--delay: expected a window around {law.d_min}:{law.d_max}, the schedule's, found {d_min}:{d_max}"
        )
    if output is not None:  # before the work, not after it
        check_conservative(str(output), law if isinstance(law, Schedule) else replace(law, d_min=d_min, d_max=d_max))
    if method == "exact":
        from gains.deciding import Question, run_certify  # with the solver: listing and showing do without

        question = Question(law, d_min, d_max, transitions, delta, memory, flown)
        return run_certify(question, name, output, as_json=as_json)
    gains = require_law(load_gains(name))
    if d_max < 1:
        raise InputError("--delay: expected a window up to at least 1 sample, found 0:0")
    return _certify_sufficient(gains, name, (d_min, d_max), method, transitions, delta, output, as_json=as_json)


def _certify_sufficient(
    gains: Gains,
    name: str,
    window: tuple[int, int],
    method: str,
    transitions: str,
    delta: float,
    output: Path | None,
    *,
    as_json: bool,
) -> int:
    """Certify by a sufficient condition, print the answer, write the gains, and return the exit code."""
    from gains import lyapunov, printed

    d_min, d_max = window
    start = _clock()
    prove = printed.eta if method == "printed" else lyapunov.eta
    click.echo(f"gains: certifying {gains.name}, delay {d_min} to {d_max}, method {method}", err=True)
    found = prove(gains, d_min, d_max, delta)
    seconds = _clock() - start
    if output is not None and not write_certified(output, model_path(name), gains, found):
        click.echo(f"gains: {output} not written: there is no certificate", err=True)
    answer = {
        "verdict": found.verdict,
        "eta": found.eta,
        "eta_lower": None,
        "d_min": d_min,
        "d_max": d_max,
        "transitions": transitions,
        "method": method,
        "delta_max": delta,
        "margin": found.verification.margin if found.verdict == "stable" and found.verification is not None else None,
        "witness": None,
        "growth_per_sample": None,
        "seconds": seconds,
        "reason": found.reason or None,
    }
    if as_json:
        print_json(answer)
    else:
        click.echo(_verdict_line(gains, found, d_min, d_max, delta))
    return SUCCESS if found.verdict == "stable" else NEGATIVE


@click.command()
@click.argument("name", metavar="GAINS")
@click.option("--d-min", type=click.IntRange(0, DELAY_LIMIT), default=1, show_default=True)
@click.option("--limit", type=click.IntRange(1, DELAY_LIMIT), default=20, show_default=True)
@click.option("--method", type=click.Choice(["exact", "lyapunov", "constant"]), default="exact", show_default=True)
@TRANSITIONS_OPTION
@PLOT_OPTION
@JSON_OPTION
def bound(
    name: str, d_min: int, limit: int, method: str, transitions: Transitions, plot: Path | None, as_json: bool
) -> int:
    """Find the largest d_max up to a limit for which GAINS are proved stable on [d_min, d_max].

    'exact' gives a proof at d_max and a delay sequence that breaks d_max + 1; --plot draws growth and gain against
    the delay. 'lyapunov' is Lemma 1, a sufficient condition; 'constant' is exact for delays that never change.
    """
    law = require_law(load_law(name))
    if limit < d_min:
        raise InputError(f"--limit: expected at least d_min ({d_min}), found {limit}")
    if isinstance(law, Schedule) and not d_min <= law.d_min <= law.d_max <= limit:
        raise InputError(
            f"--limit: expected delays around {law.d_min} to {law.d_max}, the schedule's, found {d_min} to {limit}"
        )
    if method == "exact":
        from gains.deciding import run_bound

        return run_bound(law, d_min, limit, transitions, as_json=as_json, plot=plot)
    if plot is not None:
        raise InputError(f"--plot: expected method exact, found {method}")
    return _bound_sufficient(require_law(load_gains(name)), d_min, limit, method, transitions, as_json=as_json)


def _bound_sufficient(gains: Gains, d_min: int, limit: int, method: str, transitions: str, *, as_json: bool) -> int:
    """Find the largest d_max by Lemma 1, or for constant delays; print the answer and return the exit code."""
    from gains import lyapunov

    start = _clock()
    click.echo(f"gains: bounding the delay of {gains.name} from {d_min} up to {limit}, method {method}", err=True)
    search = lyapunov.largest_constant_d if method == "constant" else lyapunov.largest_d_max
    found = search(gains, d_min, limit)
    latency = None if found.d_max is None else found.d_max * gains.model.Ts
    refuted = None
    if found.refuted is not None:
        d, growth = found.refuted
        refuted = {"d_max": d, "witness": [d], "growth_per_sample": growth}
    answer = {
        "d_min": d_min,
        "d_max": found.d_max,
        "seconds_of_latency": latency,
        "limit": limit,
        "method": method,
        "transitions": transitions,
        "refuted": refuted,
        "seconds": _clock() - start,
    }
    if as_json:
        print_json(answer)
    else:
        kind = "constant delay" if method == "constant" else "varying delay"
        proved = f"none from {d_min}" if latency is None else f"up to {found.d_max} samples ({latency * 1e3:g} ms)"
        more = (
            "" if refuted is None else f"; {refuted['d_max']} diverges, {refuted['growth_per_sample']:.6f} per sample"
        )
        click.echo(f"{gains.name}: {kind} proved stable {proved}{more}")
    return NEGATIVE if found.d_max is None else SUCCESS


@click.command()
@click.argument("name", metavar="GAINS")
@click.option("--delay", required=True, metavar="MIN:MAX", help="Window of delays in samples.")
@TRANSITIONS_OPTION
@click.option("-o", "--output", type=click.Path(path_type=Path), callback=writable, required=True, help="The CSV file.")
@PLOT_OPTION
@JSON_OPTION
def witness(name: str, delay: str, transitions: Transitions, output: Path, plot: Path | None, as_json: bool) -> int:
    """Find a periodic delay sequence in a window under which GAINS diverge, and write it as CSV.

    The sequence of largest growth found is written; its growth is confirmed in multiple precision. 'sitl relay
    --witness' and the scenarios 'witness' fly it. --plot draws the loop under it.
    """
    gains, window = require_law(load_gains(name)), parse_window(delay)
    from gains.deciding import run_witness

    return run_witness(gains, window, transitions, output, as_json=as_json, plot=plot)


@click.command()
@click.argument("names", metavar="GAINS...", nargs=-1, required=True)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), callback=writable, required=True, help="The gain file."
)
@TRANSITIONS_OPTION
@click.option("--delta", type=FiniteRange(min=0.0), default=0.0, help="Bound on the uncertainty; default 0: none.")
@JSON_OPTION
def schedule(names: tuple[str, ...], output: Path, transitions: Transitions, delta: float, as_json: bool) -> int:
    """Join GAINS, each with the window of its file, into one schedule, and certify it under every switching.

    The set of a command may be any whose window, widened by one sample for a wrong estimate, contains its delay.
    """
    from gains.deciding import run_schedule

    return run_schedule(names, output, transitions, delta, as_json=as_json)


@click.command()
@click.argument("model", metavar="MODEL")
@click.option("--delay", required=True, metavar="MIN:MAX", help="Window of delays in samples.")
@click.option(
    "--method",
    type=click.Choice(["exact", "lyapunov", "ccl", "printed"]),
    default="exact",
    show_default=True,
    help="'exact' is the switched system itself, 'lyapunov' is Lemma 1.",
)
@click.option(
    "--search",
    type=click.Choice(["best", "quasi-newton", "convexify"]),
    default="best",
    show_default=True,
    help="How 'exact' and 'lyapunov' look for gains.",
)
@click.option(
    "--memory",
    type=click.IntRange(0, 4),
    default=0,
    show_default=True,
    help="Past delays that a storage of 'exact' knows: tighter and slower.",
)
@TRANSITIONS_OPTION
@click.option("--delta", type=FiniteRange(min=0.0), default=0.0, help="Bound on the uncertainty; default 0: none.")
@click.option(
    "--steady-state",
    type=click.Choice(["exact", "free"]),
    default="exact",
    show_default=True,
    help="Whether the error vanishes for every constant reference.",
)
@click.option("--start", help="Gains to start from; default: found from the model alone.")
@click.option("--iterations", type=click.IntRange(1, 10_000), help="Most iterations of the method.")
@click.option(
    "--weight",
    type=(click.Choice(["w", "r", "e", "effort"]), FiniteRange(min=0.0)),
    multiple=True,
    metavar="NAME NUMBER",
    help="Weight on w, r or e, or rho of the control effort; may be repeated.",
)
@click.option(
    "--limit",
    type=(click.Choice(["K1", "K2"]), FiniteRange(min=0.0, min_open=True)),
    multiple=True,
    metavar="K1|K2 NUMBER",
    help="Bound on the size of every entry; may be repeated.",
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), callback=writable, required=True, help="The gain file."
)
@JSON_OPTION
def design(model: str, delay: str, output: Path, as_json: bool, transitions: str, **options: Any) -> int:
    """Design gains for MODEL with a small eta for every delay in a window, and prove it.

    The file is written with its certificate. A proof for transitions 'any' holds for 'fifo' too. Ctrl-C keeps
    the best gains so far.
    """
    from gains.designing import run_design

    options["transitions"] = transitions
    return run_design(model, parse_window(delay), output, as_json=as_json, options=options)


def parse_window(text: str) -> tuple[int, int]:
    """Return the d_min and d_max of ``MIN:MAX``."""
    match = re.fullmatch(r"(\d{1,6}):(\d{1,6})", text)
    if match is None:
        raise InputError(f"--delay: expected MIN:MAX in samples, such as 1:3, found {text!r}")
    d_min, d_max = int(match[1]), int(match[2])
    if not d_min <= d_max <= DELAY_LIMIT:
        raise InputError(f"--delay: expected MIN <= MAX <= {DELAY_LIMIT}, found {text}")
    return d_min, d_max


def write_certified(output: Path, model: str | Path, law: GainLaw, found: Analysis | ExactAnalysis | Decision) -> bool:
    """Write gains with the certificate that was found for them; return whether there was one.

    The window of the file is the certificate's; a schedule keeps its own.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    if found.certificate is None or found.verification is None or found.verdict != "stable":
        return False
    versions = {part: metadata.version(part) for part in ("clarabel", "numpy")} | {"lagproof": version()}
    certificate = found.certificate.table(law, found.verification.margin, versions)
    if isinstance(law, Schedule):
        proved: GainLaw = replace(law, certificate=certificate)
    else:
        d_min, d_max = found.certificate.d_min, found.certificate.d_max
        proved = replace(law, d_min=d_min, d_max=d_max, certificate=certificate)
    try:
        save_gains(output, proved, model)
    except OSError as error:
        raise InputError(f"{output}: {error.strerror or error}") from None
    return True


def _verdict_line(gains: Gains, found: Analysis, d_min: int, d_max: int, delta: float) -> str:
    where = f"{gains.name}: {found.verdict} for delays {d_min} to {d_max}"
    where += f" and ||Delta|| <= {delta:g}" if delta > 0.0 else ""
    where += "" if found.eta is None else f", eta {found.eta:.6g}"
    if found.verdict == "stable" and found.verification is not None:
        where += f" (verified: margin {found.verification.margin:.2g}, rounding {found.verification.rounding:.2g})"
    return where + (f": {found.reason}" if found.reason else "")
