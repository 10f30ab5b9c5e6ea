"""Ablation: rows are trained, measured, kept and shown."""

import json

import pytest
from toy import make_toy_capture

from catacaustics.ablation import ablate, format_rows, summary
from catacaustics.config import AblateConfig
from catacaustics.errors import UserError


def config_of(root, **options):
    rows = ("primary only", "half warp")
    settings = {"minutes": None, "iterations": 10, "image_size": 64, "rows": rows, "seeds": (0, 1)}
    return AblateConfig(root / "capture", root / "out", **(settings | options))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("ablation")
    make_toy_capture(root / "capture")
    return root, ablate(config_of(root, json=root / "copy.json"))


def test_every_row_is_trained_with_every_seed_and_measured_along_the_way(finished):
    root, result = finished
    assert [(r["name"], r["seed"]) for r in result["results"]] == [
        (name, seed) for seed in (0, 1) for name in ("primary only", "half warp")
    ]
    for row in result["results"]:
        seconds, steps = ([c[k] for c in row["curve"]] for k in ("seconds", "steps"))
        assert seconds == sorted(seconds)
        assert steps == sorted(steps)
        assert steps[-1] == 10
        assert all(5 < c["inside"] < 60 and 0 <= c["flicker"] < 1 for c in row["curve"])
    assert json.loads((root / "copy.json").read_text())["results"] == result["results"]


def test_the_table_gives_means_over_seeds_and_the_page_a_chart(finished):
    root, result = finished
    rows = summary(result["results"])
    assert [r["seeds"] for r in rows] == [2, 2]
    ends = [r["curve"][-1]["inside"] for r in result["results"] if r["name"] == "half warp"]
    assert next(r for r in rows if r["name"] == "half warp")["inside"] == pytest.approx(sum(ends) / 2)
    assert "half warp" in format_rows(result["results"])
    page = (root / "out" / "ablation.html").read_text()
    assert (root / "out" / "ablation.svg").read_text().startswith("<svg")
    assert "<svg" in page
    assert "primary only" in page


def test_finished_rows_are_kept(finished, capsys):
    root, result = finished
    assert ablate(config_of(root))["results"] == result["results"]
    assert capsys.readouterr().out.count("is finished, kept") == 4


def test_an_unknown_row_is_refused_with_the_names_there_are(finished):
    root, _ = finished
    with pytest.raises(UserError, match="no row 'parabola'"):
        ablate(config_of(root, rows=("parabola",)))


def test_a_capture_without_masks_is_refused(tmp_path):
    make_toy_capture(tmp_path / "capture", masks=False)
    with pytest.raises(UserError, match="masks of a reflector"):
        ablate(config_of(tmp_path))
