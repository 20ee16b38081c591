"""Written TOML reads back as the same values, and an edited file keeps its comments."""

import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtloop.design.toml_text import edit_text, write_section

WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=10)
KEYS = st.text("abcdefgh_", min_size=1, max_size=4)
SCALARS = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | WORDS
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4), max_leaves=12
)
TABLES = st.dictionaries(KEYS, VALUES, max_size=5)


@given(TABLES)
def test_whatever_is_written_is_read(values):
    assert tomllib.loads(write_section("", values, ["a comment", ""])) == values


@given(TABLES, TABLES)
def test_whatever_is_changed_says_what_it_should(old, new):
    assert tomllib.loads(edit_text(write_section("", old), new, ["why"])) == new


@pytest.mark.parametrize("number", [0.1, 1e-300, 5e-324, 1e22, -0.0, float("inf"), np.float64(2 / 3)])
def test_a_number_keeps_its_bits(number):
    number_read = tomllib.loads(write_section("x", {"a": number}))["x"]["a"]
    assert np.float64(number_read).tobytes() == np.float64(number).tobytes()


TEXT = """\
# the stage on the left table
[loop]
rate_hz = 10000     # as fast as the sensor
mode = "raw"        # until there is a law

[[axis]]
name = "x"          # along the beam
# the weights are last year's
[axis.feedforward]
weights = [1.0, 2.0]

[[axis]]
name = "y"

# where the disk is
[recording]
folder = "recordings"
"""


def test_comments_are_kept_and_what_is_new_has_its_place():
    values = tomllib.loads(TEXT)
    del values["loop"]["mode"]
    values["axis"][0] |= {"specification": "spec.toml", "controller": {"gain": 3.0, "poles": [[-1.0, 2.0]] * 12}}
    values["axis"][0]["feedforward"]["weights"] = [4.0]
    text = edit_text(TEXT, values, ["made anew"])
    assert tomllib.loads(text) == values
    assert text.startswith("# made anew\n")
    for line in ("# the stage on the left table", "# as fast as the sensor", "# along the beam", "# where the disk is"):
        assert line in text
    assert "until there is a law" not in text
    assert text.index("# made anew") < text.index("# the stage") < text.index("specification") < text.index('"y"')


@pytest.mark.parametrize(
    "text",
    [
        'axis = [{ name = "x" }]',
        'axis = [\n  { name = "x", feedforward.weights = [1.0] },\n]',
        '[[axis]]\nname="x"\nf.w=1\n',
    ],
)
def test_other_ways_to_write_the_same(text):
    values = tomllib.loads(text)
    values["axis"][0] |= {"controller": {"gain": 3.0}, "specification": "a.toml"}
    assert tomllib.loads(edit_text(text, values)) == values


STALE = """\
#:schema ./rtloop.schema.json
# my stage

# its rate
[loop]
rate_hz = 10000
# above the limits

# nine tenths of its range
[axis.limits]
drive_v = 9.0       # or it breaks

# The integrator is slow.
[axis.controller]   # until there is a faster one
# a tenth of the rate
ki_per_s = 100.0    # 1/s
list = [
    [1.0],
]
# what trips
[axis.interlocks]
swings = 0          # off
position_um = 9.0   # the stop

# a step
[[schedule]]
at_tick = 1
# to 5 V
[schedule.reference]
value = 5.0

# a backup
[[schedule]]
at_tick = 2
"""


def test_comments_go_with_the_sections_that_are_written_anew():
    values = tomllib.loads(STALE)
    del values["schedule"]
    values["axis"]["controller"] = {"gain": 1.0, "list": [[1.0]]}
    values["axis"]["interlocks"]["swings"] = 8
    edited = edit_text(STALE, values, ["made anew"], ["controller", "limits"])
    assert tomllib.loads(edited) == values
    assert edited.startswith("#:schema ./rtloop.schema.json\n\n# made anew\n\n# my stage\n\n# its rate\n[loop]\n")
    for comment in ("integrator", "tenth of the rate", "1/s", "# off", "a step", "to 5 V", "a backup"):
        assert comment not in edited, comment
    for comment in ("above the limits", "nine tenths", "or it breaks", "# what trips\n[axis.interlocks]", "the stop"):
        assert comment in edited, comment
    edited_twice = edit_text(edited, values, ["made once more"], ["controller"])
    assert edited_twice.startswith("#:schema ./rtloop.schema.json\n\n# made once more\n\n# made anew\n")
    assert edited_twice.count("#:schema") == 1


def test_a_table_of_another_axis_keeps_its_comments():
    text = "# of x\n[[axis]]\n# old\n[axis.c]\na = 1\n# of y\n[[axis]]\n# still true\n[axis.c]\na = 1\n"
    values = {"axis": [{"c": {"a": 2}}, {"c": {"a": 1}}]}
    edited = edit_text(text, values, (), ["c"])
    assert tomllib.loads(edited) == values
    assert edited == text.replace("# old\n", "").replace("a = 1", "a = 2", 1)


@given(TABLES, TABLES, st.lists(KEYS))
def test_comments_never_change_values(old, new, rewritten):
    text = write_section("", old, ["why"]).replace("\n[", "\n# about the next\n[")
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    assert tomllib.loads(edit_text(text, new, ["anew"], rewritten)) == new
