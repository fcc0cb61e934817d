"""`sorvolo models`: the detection models that are installed."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import AsJson, argument, names, option
from sorvolo.cli.printing import FAILED, Console, facts_table, new_table, print_json
from sorvolo.errors import InputError, SettingsError
from sorvolo.paths import Json, JsonView

if TYPE_CHECKING:
    from sorvolo.detection.contract import ModelInfo
    from sorvolo.detection.models import InstalledModel

models_app = typer.Typer(no_args_is_help=True)

_MEASURED = "measured"
"""In a card: {set: {class: {labels, AP50, AP}}}, each share with value, low and high; by which version and how, where
that is not this one."""


@models_app.callback()
def models() -> None:
    """List, show, verify and import detection models."""


@models_app.command("list")
def list_models(
    as_json: AsJson = False,
) -> None:
    """List the models that --model accepts: the packaged ones and your own.

    Your own models lie in $SORVOLO_MODELS, or in sorvolo/models of your data folder.

    Example: sorvolo models list
    """
    from sorvolo.detection.models import installed_models, models_folder

    rows = [_row(each) for each in installed_models()]
    if as_json:
        print_json(rows)
        return
    sound = [row for row in rows if "error" not in row]
    table = new_table("name", "preset", "classes", "light", "numbers", "MB", "file")
    for row in sound:
        table.add_row(
            escape(row["name"]),
            escape(row["preset"]),
            escape(", ".join(f"{each}{_when(row, each)}" for each in row["classes"])),
            _light(row),
            row["precision"],
            f"{row['bytes'] / 1e6:.1f}",
            "with the package" if row["is_packaged"] else escape(row["path"]),
        )
    if sound:
        Console().print(table)
    for row in rows:
        if "error" in row:  # below the table: no column is wide enough for the reason
            typer.echo(f"{row['name']} cannot be used: {row['error']}")
    if not rows:
        typer.echo(f"no models are installed; put your own into {models_folder()}")
    _show_hidden()


def _show_hidden() -> None:
    from sorvolo.detection.models import hidden_models

    for each in hidden_models():
        typer.echo(
            f"{each.path} is not used: '{each.name}' is the name of a packaged model; rename the file"
        )


@models_app.command()
def show(
    model: Annotated[str, argument("A model's name, or a .onnx file.")] = "default",
    as_json: AsJson = False,
) -> None:
    """Show a model: its classes, score thresholds and object sizes, licence, card.

    Example: sorvolo models show default
    """
    from sorvolo.detection.models import InstalledModel, file_sha256, find_model, read_card
    from sorvolo.detection.session import read_info

    path = find_model(model)
    info, card = read_info(path), read_card(InstalledModel(path.stem, path, False))
    facts = vars(info) | {"path": str(path), "sha256": file_sha256(path), "card": card}
    if as_json:
        print_json(facts)
        return
    told = "preset", "version", "precision", "licence", "trained_on", "created", "path", "sha256"
    rows = [(name.replace("_", " "), escape(str(facts[name]))) for name in told]
    rows.append(("light", _light(facts)))
    if info.second_only:
        use = "looks again at what other models report; it cannot search whole pictures (--model)"
        rows.append(("use", use))
    for each in info.classes:
        least_px, most_px = info.best_px[each]
        reported = (
            "reported only where asked for (--classes)," if each in info.on_request else "reported"
        )
        sizes = f"found well from {least_px:g} to {most_px:g} px"
        words = f"{reported} from score {info.thresholds[each]:.2f} on; {sizes}"
        rows.append((escape(each), words))
    rows.append(("scores", _meaning(info)))
    for key, value in card.items():
        if key not in facts and key != _MEASURED:
            rows.append((escape(key.replace("_", " ")), escape(_in_words(value))))
    console = Console()
    console.print(facts_table(escape(info.name), rows))
    if measured := _measured(card.get(_MEASURED)):
        console.print(measured)


@models_app.command()
def verify(
    model: Annotated[
        str, argument("A model's name, or a .onnx file.", show_default="all installed")
    ] = "",
    sha256: Annotated[str, option("Expected SHA-256.", show_default="the recorded one")] = "",
) -> None:
    """Check that models are complete, unchanged and can run. The exit code is 1 if one fails.

    Example: sorvolo models verify

    Example of a file: sorvolo models verify coast.onnx --sha256 9f86d081884c7d65...
    """
    from sorvolo.detection.models import InstalledModel, find_model, installed_models

    if sha256 and not model:
        raise typer.BadParameter("name the model that has this hash", param_hint="--sha256")
    wanted = sha256.strip().lower()
    if wanted and not re.fullmatch(r"[0-9a-f]{64}", wanted):
        raise SettingsError(
            f"--sha256 {sha256!r}: a SHA-256 has 64 hexadecimal digits; ask whoever gives the model"
        )
    chosen = installed_models()
    if model:
        path = find_model(model)
        chosen = [known for known in chosen if known.path == path] or [
            InstalledModel(path.stem, path, False)
        ]
    all_good = True
    for known in chosen:
        words, is_bad = _verdict(known, wanted)
        all_good = all_good and not is_bad
        typer.echo(f"{known.name}: {words}")
    if not chosen:
        typer.echo("no models are installed")
    if not model:
        _show_hidden()
    if not all_good:
        raise typer.Exit(FAILED)


@models_app.command("import")
def import_file(
    file: Annotated[Path, argument("An .onnx file of another maker.")],
    name: Annotated[str, option("Its name for --model.", show_default="the file's")] = "",
    layout: Annotated[
        str,
        option(
            "yolov8 (also YOLO11), yolov5, yolox, yolov10 (NMS inside), rtdetr, dfine, rfdetr or nanodet."
        ),
    ] = "auto",
    classes: Annotated[
        str,
        option("Its classes in its order.", show_default="as in the file, or COCO's"),
    ] = "",
) -> None:
    """Install a YOLO, RT-DETR, NanoDet or similar ONNX file as a model of your own.

    It runs in a process of its own with limited memory. `sorvolo evaluate detector` shows how well it finds.

    Example: sorvolo models import yolo11n.onnx --name yolo

    Example of a file that names no classes: sorvolo models import net.onnx --classes person,car
    """
    from sorvolo.detection.models import import_model
    from sorvolo.detection.session import read_info

    known = import_model(file, name, layout, names(classes) or None)
    info = read_info(known.path)
    asked = f"; with --classes also: {', '.join(info.on_request)}" if info.on_request else ""
    typer.echo(
        f"{known.name}: {info.layout}, finds {', '.join(info.usual_classes)}{asked}. Use it: --model {known.name}"
    )


def _in_words(value: Any) -> str:
    """A card's value for people: lists line by line, objects as name and value."""
    if isinstance(value, list):
        return "\n".join(_in_words(each) for each in value)
    if isinstance(value, Mapping):
        between = "; " if any(isinstance(each, Mapping) for each in value.values()) else ", "
        return between.join(f"{key} {_in_words(each)}" for key, each in value.items())
    return str(value)


def _measured(sets: Any) -> Table | None:
    """The card's measurements, a row for each class of each set; None where it has none of the usual form."""
    title = "measured on pictures held out"
    numbers = "labels", "AP50 %", "AP %"
    table = new_table("set", "class", *numbers, right=numbers, title=title)
    for name, classes in sets.items() if isinstance(sets, Mapping) else ():
        for label, row in classes.items() if isinstance(classes, Mapping) else ():
            if isinstance(row, Mapping):
                table.add_row(
                    escape(name.replace("_", " ")),
                    escape(label),
                    str(row.get("labels", "-")),
                    _interval(row.get("AP50")),
                    _interval(row.get("AP")),
                )
    return table if table.rows else None


def _interval(share: Any) -> str:
    """ "62.2 (42.3-77.3)" of a share with its interval, "-" where it is not known."""
    numbers = (
        [share.get(key) for key in ("value", "low", "high")]
        if isinstance(share, Mapping)
        else [share]
    )
    known = [f"{100 * each:.1f}" for each in numbers if isinstance(each, int | float)]
    return f"{known[0]} ({known[1]}-{known[2]})" if len(known) == 3 else known[0] if known else "-"


def _row(model: "InstalledModel") -> Json:
    from sorvolo.detection.session import read_info

    row: Json = {
        "name": model.name,
        "path": str(model.path),
        "is_packaged": model.is_packaged,
    }
    try:
        return (
            row
            | vars(read_info(model.path))
            | {"name": model.name, "bytes": model.path.stat().st_size}
        )
    except InputError as error:
        return row | {"error": f"{error}"}


def _when(facts: JsonView, name: str) -> str:
    """A word on a class that is not reported in every picture."""
    if facts["second_only"]:
        return " (in other models' reports)"
    return " (on request)" if name in facts["on_request"] else ""


def _meaning(info: "ModelInfo") -> str:
    """What the model's scores mean, in words."""
    if info.second_only:
        return "what it makes of a report; the model that reported weighs them"
    known = [name for name in info.classes if name in info.calibration]
    shares = f"shares, of {', '.join(known)}: of what has 0.5, about half is right"
    if len(known) == len(info.classes):
        return shares
    others = ", ".join(name for name in info.classes if name not in known)
    return f"{shares}; of {others} they only order reports" if known else "they only order reports"


def _light(facts: JsonView) -> str:
    """The light that a model knows, in words."""
    if not facts["thermal"]:
        return "day"
    if not facts["daylight"]:
        return "thermal"
    return f"day; thermal by {facts['thermal_by']}" if facts["thermal_by"] else "day and thermal"


def _verdict(model: "InstalledModel", sha256: str) -> tuple[str, bool]:
    """What to report of a model, and whether it is bad."""
    from sorvolo.detection.models import Integrity, file_sha256, integrity
    from sorvolo.detection.session import read_info

    try:
        if sha256:
            state = Integrity.GOOD if file_sha256(model.path) == sha256 else Integrity.CHANGED
        else:
            state = integrity(model)
        if state is Integrity.CHANGED:
            expected = "the given" if sha256 else "the recorded"
            return (
                f"CHANGED: its SHA-256 is not {expected} one; do not use it, get it again",
                True,
            )
        read_info(model.path)
    except InputError as error:
        return f"BAD: {error}", True
    if state is Integrity.NOT_RECORDED:
        return f"can run, but no hash is recorded; it is {file_sha256(model.path)}", False
    return "good", False
