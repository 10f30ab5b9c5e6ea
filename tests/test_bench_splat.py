"""The splatter's benchmark measures what it says, on sizes that take no time."""

import json
import math
import sys
from pathlib import Path

import pytest
from splatter import needs_native, problem

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

import bench_splat

pytestmark = needs_native


def test_every_section_writes_its_figures(tmp_path, monkeypatch, capsys):
    small = {"20k": (300, 60, 40), "200k": (600, 60, 40), "1M": (900, 60, 40)}
    monkeypatch.setattr(bench_splat, "SIZES", small)
    monkeypatch.setattr(bench_splat, "OPAQUE", (2000, 60, 40))
    monkeypatch.setattr(bench_splat, "GROWTH", (300, 600, 1200))
    monkeypatch.setattr(sys, "argv", ["bench_splat.py", "--runs", "1", "--json", str(tmp_path / "bench.json")])
    bench_splat.main()
    figures = json.loads((tmp_path / "bench.json").read_text())
    times = [row for row in figures["speed"] if "forward" in row]
    assert [(row["size"], row["backend"]) for row in times] == [(s, b) for s in small for b in ("cpu", "reference")]
    assert all(row["forward"] > 0 and row["backward"] > 0 for row in times)
    told = capsys.readouterr().out
    assert told.count("times as fast as the reference") == 3
    exact, fast, *_ = (row for row in figures["cut-offs"] if row["size"] == "opaque")
    assert exact["image_max"] == exact["gradient"] == 0
    assert 0 < fast["image_max"] <= 1.01e-4  # what early stop leaves of the light, over features of at most 1
    pairs = [row["pairs"] for row in figures["growth"]]
    assert pairs[1] / pairs[0] == pytest.approx(2, rel=0.2)
    if Path("/proc/self/clear_refs").exists():
        assert all(math.isfinite(row["memory"]) for row in figures["growth"])
    rounding = {row["result"]: row["of_norm"] for row in figures["rounding"]}
    assert all(0 < error < 3e-5 for error in rounding.values())
    assert set(rounding) == {"image", "transmittance", *bench_splat.NAMES}
    assert figures["gsplat"] == [] or not problem("cuda")
