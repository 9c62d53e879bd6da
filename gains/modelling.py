"""Commands that make or move models and gains: ``gains reference``, ``baseline``, ``export``, ``import``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click
from rich.console import Console

from gains.command import FiniteRange, print_json
from gains.model import Model
from gains.modelfile import Continuous, save_model
from gains.proving import JSON_OPTION, parse_window, writable
from gains.store import load, load_model, resolve, save_gains
from gains.table import InputError, Table
from gains.templates import DAMPING, TEMPLATES, Template, with_reference

__all__ = ["baseline", "export", "import_", "reference"]

_FILE = click.Path(dir_okay=False, path_type=Path)
_OUTPUT = click.option("-o", "--output", type=_FILE, callback=writable, required=True)
_POSITIVE = FiniteRange(0.0, min_open=True)


@click.command()
@click.argument("model_name", metavar="MODEL")
@click.option("--template", type=click.Choice(list(TEMPLATES)), default="level1", show_default=True)
@click.option("--bandwidth", type=_POSITIVE, help="rad/s; by default after the short period.")
@click.option("--damping", type=_POSITIVE, default=DAMPING, show_default=True)
@_OUTPUT
def reference(model_name: str, template: Template, bandwidth: float | None, damping: float, output: Path) -> None:
    """Write MODEL with a reference model by template: a level-1 short period, or a plain second order."""
    model = with_reference(load_model(model_name), template, bandwidth=bandwidth, damping=damping)
    note = f"{model.name}, with a reference model by template {template}: gains reference."
    save_model(output, replace(model, name=output.stem), plant=_continuous(model_name), notes=[note])
    click.echo(f"{output}: {model.name} with template {template}")


def _continuous(model_name: str) -> Continuous | None:
    """Return the plant of a model file before it is held; None where the file has it discrete."""
    plant = Table.load(resolve(model_name)).table("plant")
    if not plant.boolean("continuous"):
        return None
    model = load_model(model_name)
    A, B = plant.matrix("A"), plant.matrix("B")
    return Continuous(A, B, plant.matrix("E") if model.nw else model.E)


@click.command()
@click.argument("model_name", metavar="MODEL")
@click.option("--controller", type=click.Choice(["lq", "smith", "dfsm"]), required=True, help="Which one.")
@click.option("--delay", required=True, metavar="MIN:MAX", help="Window in which it may fly; dfsm is tuned for it.")
@click.option("--effort", type=_POSITIVE, help="Weight of the elevator in lq and smith, beside an error's 1.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Of the search of dfsm.")
@_OUTPUT
def baseline(model_name: str, controller: str, delay: str, effort: float | None, seed: int, output: Path) -> None:
    """Design a controller for MODEL to compare with; nothing is proved of it.

    \b
    lq     tracking by delay-free LQ
    smith  the same gains on a state predicted to the instant of application
    dfsm   output-feedback sliding mode with integral action, its poles searched for (a minute or two)
    """
    from gains.baseline import EFFORT, lq, smith, tuned_dfsm  # with SciPy's optimisers

    model, window = load_model(model_name), parse_window(delay)
    if controller == "dfsm":
        if effort is not None:
            raise InputError("--effort: expected with --controller lq or smith")
        console = Console(stderr=True)
        with console.status("searching for poles") as status:

            def tell(best: float) -> None:
                status.update(f"searching for poles: rms error {best:.4g} degrees")

            gains = tuned_dfsm(model, window, output.stem, seed=seed, progress=tell)
    else:
        gains = (lq if controller == "lq" else smith)(model, window, output.stem, EFFORT if effort is None else effort)
    save_gains(output, gains, resolve(model_name))
    click.echo(f"{output}: {controller} for delays {window[0]} to {window[1]}; nothing is proved of it")


@click.command()
@click.argument("name")
@_OUTPUT
def export(name: str, output: Path) -> None:
    """Write the model or the gains NAME as a NumPy (.npz) or MATLAB (.mat) file (docs/interop.md)."""
    from gains.interop import export_file
    from gains.model import Schedule

    item = load(name)
    if isinstance(item, Schedule):
        raise InputError(f"{name}: expected a model or one set of gains, found a schedule")
    export_file(item, output)
    click.echo(f"{output}: {'model' if isinstance(item, Model) else 'gains'} {item.name}")


@click.command("import")
@click.argument("file", type=_FILE)
@click.option("--model", "model_name", help="Model that imported gains shall name; else one is written beside them.")
@_OUTPUT
@JSON_OPTION
def import_(file: Path, model_name: str | None, output: Path, as_json: bool) -> None:
    """Write the model or the gains of a .npz or .mat FILE as TOML (docs/interop.md)."""
    from gains.interop import import_file

    item = import_file(file)
    files = [output]
    if isinstance(item, Model):
        if model_name is not None:
            raise InputError(f"--model: expected gains, found {file} to hold a model")
        save_model(output, item, notes=[f"Imported from {file.name}."])
    elif model_name is not None:
        model = load_model(model_name)
        if model.nx != item.model.nx or model.nu != item.model.nu or model.nr != item.model.nr:
            raise InputError(f"--model {model_name}: expected a model for the K1 and K2 of {file}, found other sizes")
        save_gains(output, replace(item, model=model), resolve(model_name))
    else:
        beside = output.with_name(f"{output.stem}-model.toml")
        save_model(beside, item.model, notes=[f"Imported from {file.name}."])
        save_gains(output, item, beside)
        files.append(beside)
    if as_json:
        print_json({"name": item.name, "files": [str(path) for path in files]})
    else:
        click.echo(f"{output}: {item.name}" + (f", with {files[1].name}" if len(files) > 1 else ""))
