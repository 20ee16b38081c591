"""A simulated node with more than ten outputs orders its axes, and so their plants, by the numbers of their outputs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from rtloop.cli import main, service
from rtloop.configuration import file


def test_the_axes_of_a_board_are_in_the_order_of_their_outputs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    outputs = {f"axis_{number}": SimpleNamespace(output=f"dac{number}") for number in (10, 2, 0, 11, 1, 9)}
    served: list[list[str]] = []
    monkeypatch.setattr(file, "load", lambda _: SimpleNamespace(wiring=outputs))
    monkeypatch.setattr(service, "_serve_board", lambda _configuration, axes, _stopped: served.append(axes))
    result = CliRunner().invoke(main, ["hil", "serve", str(tmp_path / "board.toml")])
    assert result.exit_code == 0, result.output
    assert served == [[f"axis_{number}" for number in (0, 1, 2, 9, 10, 11)]]
