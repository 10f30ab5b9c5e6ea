"""Refraction baking in about five minutes on two cores: a small data set, quick trainings, a report to look at.

    python tools/refract_demo.py OUT [--scene checker] [--minutes 1]

Makes OUT/data (64 x 64 pixels), trains glassnet and hybrid for equal seconds and writes OUT/report/report.html with
the table, the chart and the pictures side by side. Run it again to go on after an interruption.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from catacaustics.config import RefractDataConfig, RefractReportConfig
from catacaustics.refraction.data import make_data
from catacaustics.refraction.report import report


@dataclass(frozen=True)
class Options:
    out: Path
    """Folder to write."""
    scene: str = "checker"
    """cornell, hemisphere, checker or tir."""
    minutes: float = 1.0
    """Training time of each model."""
    models: tuple[str, ...] = ("glassnet", "hybrid")
    train: int = 40
    generator: int = 120


def main(options: Options) -> None:
    started = time.monotonic()
    data = RefractDataConfig(
        options.scene,
        options.out / "data",
        train=options.train,
        val=0,
        test=6,
        generator=options.generator,
        resolution=64,
        screen=512,
        spp=36,
    )
    make_data(data)
    made = time.monotonic()
    report(
        RefractReportConfig(
            data.out,
            options.out / "report",
            models=options.models,  # pyright: ignore[reportArgumentType]
            seeds=(0,),
            minutes=options.minutes,
            shown_frames=6,
        )
    )
    print(f"demo: data {made - started:.0f} s, training and report {time.monotonic() - made:.0f} s")


if __name__ == "__main__":
    main(tyro.cli(tyro.conf.PositionalRequiredArgs[Options]))
