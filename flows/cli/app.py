"""Build the command line from its verbs, each loaded on demand."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.resources

from cyclopts import App

VERBS = {  # verb: module of its function, loaded on demand
    "survey": "spectralzoom.flows.cli.survey_verbs",
    "simulate": "spectralzoom.flows.cli.simulate_command",
    "rig check": "spectralzoom.flows.cli.rig_commands",
    "plan": "spectralzoom.flows.archive.plan_command",
    "ls": "spectralzoom.flows.archive.commands",
    "explain": "spectralzoom.flows.archive.explain_command",
    "verify": "spectralzoom.flows.archive.commands",
    "gc": "spectralzoom.flows.archive.commands",
    "push": "spectralzoom.flows.archive.bucket_commands",
    "pull": "spectralzoom.flows.archive.bucket_commands",
    "export": "spectralzoom.flows.archive.export_command",
    "reprocess": "spectralzoom.flows.archive.reprocess_command",
    "serve": "spectralzoom.flows.cli.serve_command",
    "init": "spectralzoom.flows.training.init_command",
    "train": "spectralzoom.flows.cli.model_verbs",
    "evaluate": "spectralzoom.flows.cli.model_verbs",
    "tradeoff": "spectralzoom.flows.tradeoff",
}
GOES_ON = ("survey", "train", "export", "reprocess", "simulate", "serve", "push", "pull")  # verbs that resume


def build_app(*, listed: bool) -> App:
    """Return the application; with ``listed`` its help has a line for each verb, read without importing the verb."""
    app = App(
        name="spectralzoom",
        version=lambda: importlib.metadata.version("spectralzoom"),
        help="Survey a field with a hyperspectral line scanner: class map, receipt and report.",
        suppress_keyboard_interrupt=False,  # main reports it
    )
    rig = App(name="rig", help="Check the hardware.")
    app.command(rig)
    for verb, module in VERBS.items():
        group = rig if verb.startswith("rig ") else app
        name = verb.split()[-1]
        summary = {"help": _summary(module, name)} if listed else {}  # replaces all of the verb's own help
        group.command(f"{module}:{name}", name=name, **summary)
    app.register_install_completion_command(name="completion", add_to_startup=False)
    return app


def _summary(module: str, function: str) -> str:
    """Return the first paragraph of a function's docstring, from the source."""
    package, _, name = module.rpartition(".")
    parts = ast.parse(importlib.resources.files(package).joinpath(f"{name}.py").read_bytes()).body
    own = next(part for part in parts if isinstance(part, ast.FunctionDef) and part.name == function)
    return (ast.get_docstring(own) or "").partition("\n\n")[0]
