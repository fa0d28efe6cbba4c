"""``graderd rig``: the simulated grader as a process of its own."""

from __future__ import annotations

import typer

from graderd.cli.epilog import example
from graderd.cli.passthrough import TAKES_ANYTHING, hand_over


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        context_settings=TAKES_ANYTHING,
        epilog=example(
            "graderd rig --dir grader --seed 1",
            "graderd rig dataset --out frames --scenes 300 --seed 7",
            "graderd rig -- --help          (all its options)",
        ),
    )
    def rig(context: typer.Context) -> None:
        """Run the simulated grader, or write a data set with it.

        Soil, blade, camera, virtual servo and virtual actuators in a process of their own, which announces itself in
        rig.json in its directory (a JSON object). 'dataset' writes a set of labelled frames instead. All further
        arguments are the rig's own.
        """
        arguments = context.args
        if arguments[:1] == ["dataset"]:
            hand_over("drivers.rig.dataset", arguments[1:])
        else:
            hand_over("drivers.rig", arguments)
