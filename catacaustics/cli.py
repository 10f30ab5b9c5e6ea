"""`catacaustics <command>`. Nothing heavy is imported before the command is known, so that help answers at once."""

import importlib
import sys
from typing import Annotated

from catacaustics.errors import UserError
from catacaustics.threads import rest_between_loops

# command: (module, function, configuration)
_COMMANDS = {
    "reconstruct": ("catacaustics.reconstruct", "reconstruct", "ReconstructConfig"),
    "calibrate": ("catacaustics.capture.calibrate", "calibrate", "CalibrateConfig"),
    "mask": ("catacaustics.web.server", "mask", "MaskConfig"),
    "train": ("catacaustics.web.live", "train_in_view", "TrainConfig"),
    "evaluate": ("catacaustics.evaluation", "evaluate", "EvaluateConfig"),
    "ablate": ("catacaustics.ablation", "ablate", "AblateConfig"),
    "view": ("catacaustics.web.viewer", "view", "ViewConfig"),
    "render": ("catacaustics.video", "render_video", "RenderConfig"),
    "edit": ("catacaustics.editing", "edit", "EditConfig"),
    "clone": ("catacaustics.editing", "clone", "CloneConfig"),
    "stereo": ("catacaustics.stereo", "stereo", "StereoConfig"),
    "track": ("catacaustics.tracking", "track", "TrackConfig"),
    "export": ("catacaustics.export", "export", "ExportConfig"),
    "refract data": ("catacaustics.refraction.data", "make_data", "RefractDataConfig"),
    "refract train": ("catacaustics.refraction.train", "train", "RefractTrainConfig"),
    "refract evaluate": ("catacaustics.refraction.evaluate", "evaluate", "RefractEvaluateConfig"),
    "refract report": ("catacaustics.refraction.report", "report", "RefractReportConfig"),
    "refract view": ("catacaustics.web.refraction", "view_refraction", "RefractViewConfig"),
    "doctor": ("catacaustics.doctor", "doctor", "DoctorConfig"),
}


def _help(group: str = "") -> str:
    """Help on all commands, or on those of a group ("refract")."""
    config = importlib.import_module("catacaustics.config")
    lines = [
        f"usage: catacaustics {group} COMMAND ..." if group else "usage: catacaustics COMMAND ...",
        "",
        "Photographs of shiny objects in, scenes to look around in out.",
        "",
    ]
    for command, (_, _, name) in _COMMANDS.items():
        if group and command.split()[0] != group:
            continue
        lines.append(f"  {command:<17} {getattr(config, name).__doc__.splitlines()[0]}")
    return "\n".join([*lines, "", "`catacaustics COMMAND --help` lists a command's options."])


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, 2 for bad input, 130 when interrupted."""
    rest_between_loops()
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0
    if arguments[0] == "--version":
        print(importlib.import_module("catacaustics").__version__)
        return 0
    groups = {c.split()[0] for c in _COMMANDS if " " in c}
    group = arguments[0] if arguments[0] in groups else ""
    if group and (len(arguments) == 1 or arguments[1] in ("-h", "--help", "help")):
        print(_help(group))
        return 0
    words = 2 if group else 1
    command = " ".join(arguments[:words])
    if command not in _COMMANDS:
        print(f"catacaustics: there is no command '{command}'\n\n{_help(group)}", file=sys.stderr)
        return 2
    import tyro

    module, function, name = _COMMANDS[command]
    config_type = getattr(importlib.import_module("catacaustics.config"), name)
    for field in [f for f in config_type.__annotations__ if f.endswith("_")]:  # import_: the name is a Python keyword
        kind = config_type.__annotations__[field]
        config_type.__annotations__[field] = Annotated[kind, tyro.conf.arg(name=field.removesuffix("_"))]
    config = tyro.cli(
        tyro.conf.PositionalRequiredArgs[config_type], prog=f"catacaustics {command}", args=arguments[words:]
    )
    try:
        getattr(importlib.import_module(module), function)(config)
    except UserError as error:
        print(f"catacaustics {command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"catacaustics {command}: interrupted; finished work is kept", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
