"""Find the laws of a recording that may run on this machine.

Opening a recording never runs its code. A law that is not shipped is taken from the installed laws, from a file that
the user names, or from the file that it ran from, if its text equals the recorded one; the recorded text itself runs
only if the user trusts it. The file that the law ran from is used only if no user but this one and root can have
written it, and only if it imports rtloop: a foreign recording may name any script.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rtloop.foundation.trusted import open_file
from rtloop.kernel.layout import MAX_COUPLED
from rtloop.laws.contract import ANY_NUMBER
from rtloop.laws.helpers import Helper, read_helpers
from rtloop.laws.limited.trial import try_limited
from rtloop.laws.registry import BUILT_IN, LawReference, find_law, kinds, law_class, law_layout
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import Recording


@dataclass(frozen=True)
class TrustedLaws:
    """Laws that the user allows to run: `files` named by the user, and, if `recorded`, the recorded texts."""

    files: tuple[LawReference, ...] = ()
    recorded: bool = False


NO_TRUST = TrustedLaws()
MAX_TEXT_BYTES = 1 << 20
IMPORT = re.compile(r"^(from|import) rtloop\b", re.MULTILINE)
"""Import statement that the text of every law contains."""


def recorded_laws(recording: Recording, trust: TrustedLaws = NO_TRUST) -> tuple[LawReference, ...]:
    """Return the laws of the recorded loop, in the order of the header.

    Raises RecordingError for imported signals, for a law that is missing or differs from the recorded one, and if this
    version lays out the records of the laws differently; ConfigError if a law's code ends or blocks its process.
    """
    require_law(recording)
    description = recording.header["law"]
    laws = tuple(_recorded_law(entry, recording, trust) for entry in description.get("laws", ()))
    if description.get("sha256") != law_layout(laws).description()["sha256"]:
        version = recording.header["versions"].get("rtloop") or "of an unknown version"
        raise RecordingError(
            f"{recording.paths[0]}: recorded by rtloop {version}, which stores a law's state differently; replay the "
            "recording with that version"
        )
    return laws


def require_law(recording: Recording) -> None:
    """Raise RecordingError for imported signals, which contain no law."""
    if "imported" in recording.header:
        raise RecordingError(
            f"{recording.paths[0]}: nothing to replay; the recording holds signals imported from "
            f"{recording.header['imported']['file']}, and no law. Use `rtloop info`, `plot`, `export`, `cut` or "
            "`identify`"
        )


def _recorded_law(entry: Mapping[str, object], recording: Recording, trust: TrustedLaws) -> LawReference:
    """Return the law of one header entry, for its recorded number of axes.

    Raises RecordingError if it is missing, differs from the recorded one, or has an invalid number of axes; ConfigError
    if the law's code ends or blocks its process.
    """
    law, axes = _find_law(entry, recording, trust), entry.get("axes")
    if law_class(law).axes != ANY_NUMBER:
        return law
    if not isinstance(axes, int) or not 2 <= axes <= MAX_COUPLED:
        raise RecordingError(f"{recording.paths[0]}: law {law.kind!r}: {axes!r} axes; allowed: 2 to {MAX_COUPLED}")
    return replace(law, axes=axes)


def _find_law(entry: Mapping[str, object], recording: Recording, trust: TrustedLaws) -> LawReference:
    """Return the trusted law of one header entry: a shipped one by name, any other one by name and SHA-256.

    The search covers, in this order, files that the user names, installed laws, the file that the law ran from, and, if
    trusted, the recorded text. Raises RecordingError if none of these is the recorded law or the law does not fit this
    version, ConfigError if a law's code ends or blocks its process.
    """
    name, digest, text = str(entry.get("name")), entry.get("sha256"), entry.get("text")
    location = f"{recording.paths[0]}: law {name!r}"
    if digest is None:
        if name not in BUILT_IN:
            raise RecordingError(f"{location}: unknown to this version of rtloop; allowed: {', '.join(BUILT_IN)}")
        return LawReference(name)
    for law in (*trust.files, *_installed_laws(name)):
        if law.kind == name and law.sha256 == digest:
            return law
    law = LawReference(name, str(text), str(recording.paths[0]), helpers=_recorded_helpers(entry, location))
    try:
        law = _in_place(law, str(digest), entry.get("file"))
    except ValueError as error:
        if not trust.recorded:
            raise RecordingError(
                f"{location}: no installed law equals the law that ran (sha256 {str(digest)[:12]}…), and its file "
                f"cannot be used ({error}). Use --law FILE with the law that ran, or --trust-recorded-law to run the "
                "law's text in the recording"
            ) from None
    if law.sha256 != digest:
        raise RecordingError(
            f"{location}: the law's text in the recording differs from the law that ran (sha256 of the text "
            f"{str(law.sha256)[:12]}…, of the law that ran {str(digest)[:12]}…); the recording was altered. Use "
            "--law FILE with the law that ran"
        )
    try_limited(law.file, law_class, law)
    try:
        law_layout([law])
    except ValueError as error:
        raise RecordingError(f"{location}: {error}") from None
    return law


def _recorded_helpers(entry: Mapping[str, object], location: str) -> tuple[Helper, ...]:
    """Return the helpers of the law of one header entry. Raises RecordingError for others than names with texts."""
    recorded = entry.get("helpers", [])
    try:
        helpers = tuple(Helper(item["name"], item["text"], f"{location}: {item['name']}.py") for item in recorded)  # type: ignore[attr-defined]
    except (TypeError, KeyError):
        helpers = (Helper("", None, ""),)  # type: ignore[arg-type]
    if not all(isinstance(part, str) for helper in helpers for part in helper):
        raise RecordingError(f"{location}: helpers: invalid; allowed: a list of names and texts")
    return helpers


def _in_place(recorded: LawReference, digest: str, file: object) -> LawReference:
    """Read the law `recorded` and its helpers from `file`, from which it ran, and from beside it; `digest` is the
    recorded SHA-256.

    Raises ValueError if the file is not recorded, if it or a helper is unreadable or untrusted, has another SHA-256, or
    if the file does not import rtloop.
    """
    if not isinstance(file, str) or not file.isprintable():
        raise ValueError("the law's file is not recorded")
    try:
        with os.fdopen(open_file(Path(file), os.O_RDONLY), "rb") as opened:
            text = opened.read(MAX_TEXT_BYTES).decode()
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror}") from None
    law = replace(recorded, text=text, file=file, helpers=read_helpers(text, file))
    if law.sha256 != digest:
        texts, recorded_texts = ({(helper.name, helper.text) for helper in side.helpers} for side in (law, recorded))
        names = sorted({f"{name}.py" for name, _ in texts ^ recorded_texts}) if text == recorded.text else []
        raise ValueError(f"{', '.join(names) or file} has changed since the run")
    if not IMPORT.search(law.text):
        raise ValueError(f"{file} is not a law")
    return law


def _installed_laws(name: str) -> tuple[LawReference, ...]:
    """Return the installed law of this name; () if it is shipped, missing or invalid.

    Raises ConfigError if the law's code ends or blocks its process.
    """
    if name in BUILT_IN or name not in kinds():
        return ()
    try_limited(f"law {name!r}", find_law, name)
    try:
        return (find_law(name),)
    except ValueError:
        return ()
