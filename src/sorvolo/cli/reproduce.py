"""`sorvolo reproduce`: the experiments of the thesis's chapter 4, on the UMCD dataset or a simulated one."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import AsJson, OutFolder, argument, option
from sorvolo.cli.printing import TO_CHECK, Console, print_json
from sorvolo.cli.progress import ProgressReport
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.lab.thesis.rows import Row

_DEFAULT_OUT = Path("reproduction")


Dataset = Annotated[Path | None, argument("The UMCD dataset's folder, in the thesis's layout.")]
Simulated = Annotated[bool, option("Simulate a dataset in the same layout instead.", "--simulated")]
Quick = Annotated[bool, option("Only a try: one short path, small pictures.", "--quick")]
VideoCount = Annotated[int | None, option("At most this many videos of each environment and part.")]
Okutama = Annotated[Path | None, option("Okutama-Action's folder, for its column of Table 4.6.")]
Npu = Annotated[Path | None, option("The NPU Drone-Map dataset's folder, for Table 4.1.")]
TrainSteps = Annotated[int, option("Steps of each network of Table 4.6; 0: train none.")]


def reproduce(
    dataset: Dataset = None,
    out: OutFolder = _DEFAULT_OUT,
    simulated: Simulated = False,
    quick: Quick = False,
    videos: VideoCount = None,
    okutama: Okutama = None,
    npu: Npu = None,
    train_steps: TrainSteps = 100,
    as_json: AsJson = False,
) -> None:
    """Repeat the thesis's experiments of chapter 4: Tables 4.1, 4.3 to 4.6 and the figures, beside the printed ones.

    The same command continues where it was stopped. Rows that cannot be made are listed with the reason, and the exit
    code is 3.

    Example: sorvolo reproduce UMCD --out chapter4

    Example, without the dataset: sorvolo reproduce --simulated --videos 1
    """
    from sorvolo.lab.thesis.report import PAGE, write_reproduction
    from sorvolo.lab.thesis.run import reproduce as reproduced
    from sorvolo.lab.thesis.settings import ReproductionSettings, SimulatedSize
    from sorvolo.lab.thesis.settings import quick as quick_sizes
    from sorvolo.lab.training.settings import TrainSettings

    training = None
    if train_steps:
        training = TrainSettings("thesis", steps=train_steps, batch=4, patience=0)
    settings = ReproductionSettings(videos, training=training)
    simulation = SimulatedSize()
    if quick:
        settings, simulation = quick_sizes(settings, simulation)
    if simulated == (dataset is not None):
        raise SettingsError("give the folder of the UMCD dataset, or --simulated; one of both")
    if simulated:
        dataset = out / "dataset"
        from sorvolo.lab.thesis.simulated import simulated_dataset

        with ProgressReport(Console(stderr=True)) as progress:
            for name, step in simulated_dataset(dataset, simulation, settings):
                if step.stage == "frames":
                    progress.show(
                        f"simulating {name}, {step.flight}, frame",
                        step.frames_done,
                        step.frames_total,
                    )
    assert dataset is not None
    rows: list[Row] = []
    console = Console(stderr=True)
    with ProgressReport(console) as progress:
        progress.show("reproducing, row")
        for update in reproduced(
            dataset, out, settings, okutama=okutama, npu=npu, is_whole=not simulated
        ):
            rows.append(update.row)
            progress.show("reproducing, row", update.done, update.total, update.row.id)
            if update.row.missing:
                words = f"missing  {update.row.id}: {update.row.missing}"
                console.print(words, style="yellow", markup=False, soft_wrap=True)
    document = write_reproduction(out, rows, dataset, settings, simulation if simulated else None)
    if as_json:
        print_json(document)
    else:
        # the tables as the thesis prints them
        page = out / PAGE
        from sorvolo.lab.thesis.sheets import reproduction_sheets

        console = Console()
        if missing := document["missing"]:
            words = f"{len(missing)} of {counted(len(missing) + len(document['rows']), 'row')} could not be made"
            console.print(f"{words}; {page} has the reasons", style="yellow", soft_wrap=True)
        for sheet in reproduction_sheets(document["tables"]):
            if sheet.rows:
                table = Table(
                    *map(escape, sheet.columns), title=escape(sheet.title), box=SIMPLE_HEAD
                )
                for row in sheet.rows:
                    table.add_row(*map(escape, row))
                console.print(table)
        console.print(document["size"])
        console.print(f"tables and figures: {page}", soft_wrap=True)
    if document["missing"]:
        raise typer.Exit(TO_CHECK)
