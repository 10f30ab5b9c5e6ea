"""The painter's server and logic, without a browser: masks, volumes, files, and who is refused."""

import errno
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient
from toy import ball_mask, make_toy_capture

from catacaustics.capture.dataset import open_capture
from catacaustics.errors import UserError
from catacaustics.images import read_image_bytes, read_mask, write_image
from catacaustics.reflectors.volume import ReflectionVolume, build_volume
from catacaustics.web.guard import Guard
from catacaustics.web.masks import MaskStore, StaleMask, decode_runs, encode_runs, revision
from catacaustics.web.outline import outline_scribble
from catacaustics.web.proposal import look_at_point, propose_views
from catacaustics.web.server import painter_app

BALL = Path(__file__).parent.parent / "data_samples" / "ball"
TOKEN = "token"


@pytest.fixture(scope="module")
def toy(tmp_path_factory) -> Path:
    return make_toy_capture(tmp_path_factory.mktemp("toy") / "capture", masks=False, points=False)


@pytest.fixture
def root(toy, tmp_path) -> Path:
    """A capture without masks: 8 training views and 2 held out."""
    return shutil.copytree(toy, tmp_path / "capture")


@pytest.fixture
def store(root) -> MaskStore:
    return MaskStore(open_capture(root))


@pytest.fixture
def client(root) -> TestClient:
    app = Guard(painter_app(open_capture(root)), TOKEN, 8642)
    return TestClient(app, base_url=f"http://127.0.0.1:8642/{TOKEN}/")


def true_mask(store: MaskStore, view: int) -> np.ndarray:
    return ball_mask(store.views[view].camera)


def paint(store: MaskStore, views, name="ball"):
    for view in views:
        store.save_mask(name, view, true_mask(store, view), "empty")


def save(client, store, view, mask, known="empty", name="ball"):
    body = {"reflector": name, "view": view, "runs": encode_runs(mask), "revision": known}
    return client.post("api/save", json=body)


# Masks as numbers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("density", [0, 0.01, 0.5, 1])
def test_runs_give_the_mask_back(density):
    mask = np.random.default_rng(0).random((31, 47)) < density
    runs = encode_runs(mask)
    assert sum(runs) == 31 * 47
    assert np.array_equal(decode_runs(runs, 47, 31), mask)


@pytest.mark.parametrize("runs", [[5], [1, -1, 6], ["6"], [[6]], [2.0, 4.0], [True, 5], "6", None, [2**70, 6 - 2**70]])
def test_runs_that_make_no_mask_are_refused(runs):
    with pytest.raises(UserError, match="The mask has"):
        decode_runs(runs, 3, 2)


# Proposal and outline ------------------------------------------------------------------------------------------------


def test_cameras_that_look_at_a_point_give_that_point(store):
    np.testing.assert_allclose(look_at_point([v.camera for v in store.views]), [0, -0.35, 0], atol=1e-9)


def test_the_proposed_views_see_the_target_in_the_middle_and_bound_a_ball_better_than_most_choices():
    capture = open_capture(BALL)
    cameras, center = [v.camera for v in capture.train], np.array([0, 0, 0.966])
    proposed = propose_views(cameras, look_at_point(cameras))
    assert len(set(proposed)) == 4
    for i in proposed:
        assert np.abs(cameras[i].project(center)[0] / [240, 160] - 1).max() < 0.6

    def overlap(views: list[int]) -> float:
        store = MaskStore(capture)
        changed = {i: capture.mask(capture.train[i], "ball") for i in views}
        store.masked_views = lambda reflector: []  # those on disk are of all views
        volume = store.volume("ball", changed)[0]
        ratios = []
        for view in capture.views[::6]:
            got, true = volume.project_mask(view.camera), capture.mask(view, "ball")
            ratios.append((got & true).sum() / (got | true).sum())
        return min(ratios)

    rng = np.random.default_rng(0)
    others = [overlap(rng.choice(60, 4, replace=False).tolist()) for _ in range(12)]
    assert overlap(proposed) > max(0.87, np.quantile(others, 0.9))


def test_views_that_are_painted_already_stay_proposed():
    cameras = [v.camera for v in open_capture(BALL).train]
    target = look_at_point(cameras)
    first = propose_views(cameras, target)
    assert propose_views(cameras, np.array([0.0, 0, 0.966]), painted=first) == first
    for painted in ([5], [1, 2, 3]):
        proposed = propose_views(cameras, target, painted=painted)
        assert len(set(proposed)) == 4
        assert set(painted) < set(proposed)
    assert set(propose_views(cameras, target, painted=range(20))) < set(range(20))


def zigzag(mask: np.ndarray, size: float) -> np.ndarray:
    """What a hurried hand paints over a round object."""
    import cv2

    y, x = np.nonzero(mask)
    radius = size * np.sqrt(len(x) / np.pi)
    across = np.linspace(-radius, radius, 9)
    high = np.sqrt(np.maximum(radius**2 - across**2, 0))
    points = np.stack([np.repeat(across, 2), np.stack([-high, high], 1).ravel()], -1) + [x.mean(), y.mean()]
    return cv2.polylines(np.zeros(mask.shape, np.uint8), [points.astype(np.int32)], False, 1, 6) > 0


@pytest.mark.parametrize("size", [0.85, 1.0])
def test_a_scribble_on_a_mirror_ball_becomes_its_outline(size):
    capture = open_capture(BALL)
    overlaps, before = [], []
    for i in (7, 12, 24, 30, 44, 54):
        true = capture.mask(capture.train[i], "ball")
        scribble = zigzag(true, size)
        mask = outline_scribble(capture.image(capture.train[i]), scribble)
        overlaps.append((mask & true).sum() / (mask | true).sum())
        before.append((scribble & true).sum() / (scribble | true).sum())
    assert np.mean(overlaps) > 0.94
    assert min(overlaps) > 0.82
    assert np.mean(before) < 0.75


def test_by_colour_a_scribble_on_a_plain_object_becomes_its_outline(store):
    view = store.views[0]
    true = true_mask(store, 0)
    image = read_image_bytes(store.photograph(0))
    mask = outline_scribble(image, zigzag(true, 0.5), by_color=True)
    assert (mask & true).sum() / (mask | true).sum() > 0.9
    assert mask.shape == (view.camera.height, view.camera.width)


def test_nothing_or_everything_scribbled_is_refused(store):
    image = read_image_bytes(store.photograph(0))
    for scribble, words in [(np.zeros((48, 64), bool), "nothing to outline"), (np.ones((48, 64), bool), "nearly the")]:
        with pytest.raises(UserError, match=words):
            outline_scribble(image, scribble)


# Saving --------------------------------------------------------------------------------------------------------------


def test_saved_masks_make_the_volume_that_training_will_use(client, store, root):
    for view in (0, 3, 6):
        answer = save(client, store, view, true_mask(store, view))
        assert answer.status_code == 200
    report = answer.json()["report"]
    assert report["problem"] is None
    assert all(fit > 0.9 for fit in report["fits"].values())
    assert len(report["outlines"]) == 10
    saved = ReflectionVolume.load(root / "volumes" / "ball.json")
    assert np.array_equal(saved.vertices, build_volume(open_capture(root), "ball").vertices)
    assert (root / "volumes" / "ball.ply").is_file()
    for view in (0, 3, 6):
        assert np.array_equal(read_mask(root / "masks" / "ball" / f"view_{view:02d}.png"), true_mask(store, view))


def test_outlines_cover_the_true_ball_in_every_view(client, store):
    import cv2

    for view in (0, 3, 6):
        report = save(client, store, view, true_mask(store, view)).json()["report"]
    for view, outline in enumerate(report["outlines"]):
        polygon = (np.array(outline) * 16 - 8).round().astype(np.int32)
        covered = cv2.fillPoly(np.zeros((48, 64), np.uint8), [polygon], 1, shift=4) > 0
        true = true_mask(store, view)
        assert (covered & true).sum() / true.sum() > 0.99


def test_reopening_finds_what_was_painted(client, store, root):
    client.post("api/reflectors", json={"reflectors": {"ball": "#123456", "new one": "#abcdef"}})
    save(client, store, 3, true_mask(store, 3))
    again = TestClient(Guard(painter_app(open_capture(root)), TOKEN, 8642), base_url=f"http://127.0.0.1:8642/{TOKEN}/")
    found = again.get("api/state").json()["reflectors"]
    assert found == [{"name": "ball", "color": "#123456"}, {"name": "new one", "color": "#abcdef"}]
    masks = again.get("api/masks?reflector=ball").json()
    assert list(masks) == ["3"]
    assert np.array_equal(decode_runs(masks["3"]["runs"], 64, 48), true_mask(store, 3))


def test_an_erased_mask_leaves_no_file_and_no_outdated_volume(client, store, root):
    for view in (0, 3, 6):
        save(client, store, view, true_mask(store, view))
    for view in (0, 3):
        answer = save(client, store, view, np.zeros((48, 64), bool), revision(true_mask(store, view)))
    assert answer.json()["report"]["mesh"] is None
    assert [p.name for p in (root / "masks" / "ball").iterdir()] == ["view_06.png"]
    assert not list((root / "volumes").iterdir())


def test_a_stale_tab_is_told_and_overwrites_nothing(client, store, root):
    first, second = true_mask(store, 0), np.roll(true_mask(store, 0), 5)
    assert save(client, store, 0, first).json()["revision"] == revision(first)
    answer = save(client, store, 0, second)  # a tab that still thinks that there is none
    assert answer.status_code == 409
    assert answer.json() == {"runs": encode_runs(first), "revision": revision(first)}
    assert np.array_equal(read_mask(root / "masks" / "ball" / "view_00.png"), first)
    assert save(client, store, 0, second, revision(first)).status_code == 200
    assert save(client, store, 0, second).status_code == 200  # the same mask twice is no conflict


def test_a_mask_that_another_program_changed_is_not_overwritten(store, root):
    paint(store, [0])
    write_image(root / "masks" / "ball" / "view_00.png", np.roll(true_mask(store, 0), 3))
    with pytest.raises(StaleMask):
        store.save_mask("ball", 0, np.zeros((48, 64), bool), revision(true_mask(store, 0)))


def test_of_many_tabs_that_save_at_once_one_wins_and_the_others_are_told(store, root):
    masks = [np.roll(true_mask(store, 0), i + 1) for i in range(8)]
    outcome = {}

    def work(i):
        try:
            store.save_mask("ball", 0, masks[i], "empty")
            outcome[i] = "saved"
        except StaleMask:
            outcome[i] = "told"

    threads = [threading.Thread(target=work, args=[i]) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcome.values()) == ["saved"] + ["told"] * 7
    winner = next(i for i in outcome if outcome[i] == "saved")
    assert np.array_equal(store.mask("ball", 0), masks[winner])


def test_a_server_killed_in_the_middle_of_saving_loses_neither_mask_nor_capture(store, root):
    paint(store, [0, 3, 6])
    code = """
import os, sys
from pathlib import Path
import numpy as np
from catacaustics.capture.dataset import open_capture
from catacaustics.web.masks import MaskStore, revision
store = MaskStore(open_capture(Path(sys.argv[1])))
os.fsync = lambda handle: os.kill(os.getpid(), 9)  # the new file is written, but not in its place
store.save_mask("ball", 0, np.roll(store.mask("ball", 0), 4), revision(store.mask("ball", 0)))
"""
    done = subprocess.run([sys.executable, "-c", code, str(root)], timeout=60)
    assert done.returncode == -9
    assert len(list((root / "masks" / "ball").iterdir())) == 4  # with the half-saved one
    reopened = MaskStore(open_capture(root))
    assert np.array_equal(reopened.mask("ball", 0), true_mask(store, 0))
    assert reopened.masked_views("ball") == [0, 3, 6]
    assert reopened.report("ball")["problem"] is None


@pytest.fixture
def read_only(monkeypatch):
    def refuse(*args, **kwargs):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(tempfile, "mkstemp", refuse)
    for method in ("unlink", "rename", "replace"):
        monkeypatch.setattr(Path, method, refuse)


def test_on_a_read_only_disk_the_page_is_told_and_still_gets_the_volume(client, store, root, request):
    paint(store, [0, 3])
    request.getfixturevalue("read_only")
    answer = save(client, store, 6, true_mask(store, 6))
    assert answer.status_code == 422
    assert "Cannot write" in answer.json()["found"]
    assert "Read-only" in answer.json()["found"]
    assert "folder" in answer.json()["expected"]
    body = {"reflector": "ball", "masks": {"6": encode_runs(true_mask(store, 6))}}
    report = client.post("api/report", json=body).json()
    assert report["mesh"]
    assert report["problem"] is None
    assert not (root / "masks" / "ball" / "view_06.png").exists()
    for name, body in {"delete": {"name": "ball"}, "rename": {"from": "ball", "to": "bowl"}}.items():
        assert client.post(f"api/{name}", json=body).status_code == 422
    assert store.masked_views("ball") == [0, 3]


# Conflicts named -----------------------------------------------------------------------------------------------------


def test_a_mask_that_contradicts_the_others_is_named_at_once_and_before_it_is_saved(client, store):
    paint(store, [0, 2, 4, 6])
    wrong = np.zeros((48, 64), bool)
    wrong[2:8, 2:8] = True
    report = client.post("api/report", json={"reflector": "ball", "masks": {"4": encode_runs(wrong)}}).json()
    assert report["problem"]["views"] == [4]
    assert "contradict" in report["problem"]["found"]
    assert report["mesh"] is None
    assert np.array_equal(store.mask("ball", 4), true_mask(store, 4))


def test_a_mask_of_a_view_where_something_stands_before_the_object_is_pointed_out_and_left_out(client, store):
    paint(store, range(8))
    part = true_mask(store, 4)
    columns = np.flatnonzero(part.any(0))
    part[:, columns[: len(columns) // 2]] = False
    report = client.post("api/report", json={"reflector": "ball", "masks": {"4": encode_runs(part)}}).json()
    whole = client.post("api/report", json={"reflector": "ball", "masks": {}}).json()
    assert report["problem"]["views"] == [4]
    assert "part" in report["problem"]["found"]
    assert sorted(report["fits"]) == ["0", "1", "2", "3", "5", "6", "7"]
    assert report["mesh"]["radius"] >= whole["mesh"]["radius"]
    assert whole["problem"] is None


def test_a_mask_that_is_far_too_wide_is_pointed_out(client, store):
    import cv2

    paint(store, [0, 2, 4, 6])
    wide = cv2.dilate(true_mask(store, 2).astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    report = client.post("api/report", json={"reflector": "ball", "masks": {"2": encode_runs(wide)}}).json()
    assert report["problem"]["views"] == [2]
    assert report["mesh"]


def test_one_mask_alone_is_open_and_an_all_white_one_is_named(client, store):
    report = save(client, store, 0, true_mask(store, 0)).json()["report"]
    assert "open" in report["problem"]["found"]
    report = save(client, store, 1, np.ones((48, 64), bool)).json()["report"]
    assert "all white" in report["problem"]["found"]
    assert report["problem"]["views"] == [1]


# Reflectors ----------------------------------------------------------------------------------------------------------


def test_a_renamed_reflector_keeps_masks_colour_and_volume(client, store, root):
    paint(store, [0, 3, 6])
    client.post("api/reflectors", json={"reflectors": {"ball": "#123456"}})
    assert client.post("api/rename", json={"from": "ball", "to": "silver ball"}).json()["report"]["mesh"]
    assert store.reflectors() == {"silver ball": "#123456"}
    assert open_capture(root).reflectors == ["silver ball"]
    assert sorted(p.name for p in (root / "volumes").iterdir()) == ["silver ball.json", "silver ball.ply"]
    paint(store, [0], "bowl")
    answer = client.post("api/rename", json={"from": "bowl", "to": "silver ball"})
    assert answer.status_code == 422
    assert "silver ball already" in answer.json()["found"]


def test_a_deleted_reflector_is_kept_aside(client, store, root):
    for expected in ("ball", "ball-1"):
        paint(store, [0, 3, 6])
        assert client.post("api/delete", json={"name": "ball"}).json()["kept"] == str(root / "removed_masks" / expected)
    assert store.reflectors() == {}
    assert open_capture(root).reflectors == []
    assert len(list((root / "removed_masks" / "ball-1").iterdir())) == 3


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "a/b", "a\\b", "/etc", ".hidden", "a\0b", "x" * 61, "a\n", "-x"]
)
def test_names_that_could_be_paths_are_refused(client, store, root, name):
    before = sorted(str(p) for p in root.parent.rglob("*"))
    assert save(client, store, 0, true_mask(store, 0), name=name).status_code == 422
    assert client.post("api/rename", json={"from": "ball", "to": name}).status_code == 422
    assert client.post("api/delete", json={"name": name}).status_code == 422
    assert client.get("api/masks", params={"reflector": name}).status_code == 422
    assert client.post("api/reflectors", json={"reflectors": {name: "#000000"}}).status_code == 422
    assert sorted(str(p) for p in root.parent.rglob("*")) == before


def test_a_link_that_leads_out_of_the_capture_is_not_followed(client, store, root, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (root / "masks").mkdir(exist_ok=True)
    (root / "masks" / "ball").symlink_to(outside)
    answer = save(client, store, 0, true_mask(store, 0))
    assert answer.status_code == 422
    assert "leads out of the capture" in answer.json()["found"]
    assert not list(outside.iterdir())
    shutil.move(root / "images" / "view_00.png", outside / "secret.png")
    (root / "images" / "view_00.png").symlink_to(outside / "secret.png")
    assert client.get("api/photo/0").status_code == 422
    assert client.get("api/photo/1").status_code == 200
