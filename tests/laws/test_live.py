"""Laws, their numbers and modes changed while the loop runs: the drive goes on without a jump, and a replay agrees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.engine.commands import send
from rtloop.engine.messages import Kind, message
from rtloop.recording.capture.session import Session
from rtloop.recording.replay.laws import Trust
from rtloop.recording.replay.replay import replay
from rtloop.signals import Mode
from tests.laws.failing import text as law_text
from tests.recording.real_loop import Options, RealLoop

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
PAPER = (DEPLOY / "paper.toml").read_text()
CONTROLLERS = {
    "transfer": PAPER[PAPER.index("[axis.controller]") : PAPER.index("# Eq (5)")].replace("0.016", "0.004"),
    **{
        path.stem: text[text.index("[axis.controller]") : text.index("[axis.model]")]
        for path in (DEPLOY / "laws").glob("*.toml")
        if path.stem != "coupled"
        for text in [path.read_text()]
    },
    "mine": '[axis.controller]\nfile = "mine.py"\n',
}
STANDBY = 'laws = ["integral_resonant", "mine.py", "pid", "positive_position", "repetitive"]\n'
HOLD = '[axis.reference]\nkind = "hold"\nvalue = 5.0\n'
CHANGES, APART = 120, 250
MODES = [Mode.CLOSED_LOOP, Mode.CLOSED_LOOP, Mode.FEEDFORWARD, Mode.OFF]


def configuration(controller: str) -> str:
    """The paper's loop, holding 5 µm, with a controller and all of the laws standing by."""
    start, end = PAPER.index("[axis.controller]"), PAPER.index("# Eq (5)")
    text = PAPER[:start] + controller + "\n" + PAPER[end:]
    text = text[: text.index("[axis.reference]")] + HOLD + text[text.index("# [[schedule]]") :]
    text = text.replace("rate_hz = 10000\n", "rate_hz = 10000\n" + STANDBY, 1)
    return text.replace('specification = "paper-spec.toml"', "")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("live")
    (folder / "mine.py").write_text(law_text())
    return folder


def staged(folder: Path, controllers: dict[str, str]) -> dict[str, bytes]:
    """Coefficients of each controller, as the service would stage them."""
    return {
        name: prepare(parse(configuration(text), "other", folder, "other"), paced=False).plan.coefficients.tobytes()
        for name, text in controllers.items()
    }


def changed_at_random(folder: Path, names: list[str], path: Path) -> np.ndarray:
    """A recorded run in which one of these laws follows the other, and modes; the drives, (ticks,)."""
    laws, random = staged(folder, {name: CONTROLLERS[name] for name in names}), np.random.default_rng(5)
    loop = RealLoop(configuration(CONTROLLERS[names[0]]), folder)
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0))
    loop.run(2000)
    for _ in range(CHANGES):
        if random.random() < 0.7:
            law = laws[names[int(random.integers(len(names)))]]
            loop.block["staged"][: len(law)] = np.frombuffer(law, np.uint8)
            send(loop.block, message(Kind.LOAD_LAW, axis=0, values=[1.0]))
        else:
            mode = MODES[int(random.integers(len(MODES)))]
            send(loop.block, message(Kind.SET_MODE, values=[float(mode)]))
        loop.run(APART)
        session.drain()
        session.write_due()
    loop.end()
    session.drain()
    session.finish("finished")
    recording = rtloop.load(path)
    assert not [event for event in recording.events if event["kind"] in ("tripped", "refused")]
    assert len([event for event in recording.events if event["kind"] == "load_law"]) > CHANGES // 2
    return recording["x_drive_v"]


def test_any_law_follows_any_other(folder: Path, tmp_path: Path):
    """The largest step of the drive is the one that C(z) alone makes, changed as often."""
    alone = changed_at_random(folder, ["transfer"], tmp_path / "alone.mcap")
    together = changed_at_random(folder, list(CONTROLLERS), tmp_path / "together.mcap")
    steps = [float(np.max(np.abs(np.diff(drives[2000:])))) for drives in (alone, together)]
    assert steps[1] <= max(1.5 * steps[0], 0.11), steps  # 0.1 V a tick is the ramp to safe
    report = replay(rtloop.load(tmp_path / "together.mcap"), trust=Trust(recorded=True))
    assert report.identical
    assert report.ticks == 2000 + CHANGES * APART
    assert report.snapshots > CHANGES // 2


def test_two_laws_of_one_name_keep_apart(folder: Path):
    """The digest of the text is part of what a law is."""
    one, other = (prepare(parse(configuration(CONTROLLERS["mine"]), "x", folder, "x"), paced=False).plan for _ in "ab")
    assert one.laws == other.laws
    text = (folder / "mine.py").read_text()
    (folder / "mine.py").write_text(text + "# edited\n")
    try:
        edited = prepare(parse(configuration(CONTROLLERS["mine"]), "x", folder, "x"), paced=False).plan
    finally:
        (folder / "mine.py").write_text(text)
    assert edited.laws != one.laws
