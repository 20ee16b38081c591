"""Bodies and queries of requests for recordings, each value bounded."""

from __future__ import annotations

from typing import Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rtloop.configuration.file import describe
from rtloop.recording.file.topics.ticks import LARGEST

M = TypeVar("M", bound=BaseModel)
LONGEST_S = 600.0


class CaptureBody(BaseModel):
    """Body of a capture: ticks `first` … `end` − 1 of the run with number `run`, or its last `seconds`.

    `run` None is the present run.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    run: int | None = None
    first: int | None = Field(default=None, ge=-LARGEST, le=LARGEST)
    end: int | None = Field(default=None, ge=1, le=LARGEST)
    seconds: float | None = Field(default=None, gt=0, le=LONGEST_S)

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return this body; ValueError unless it has either `seconds`, or both `first` and `end` with first < end."""
        if (self.first is None) != (self.end is None) or (self.seconds is None) == (self.first is None):
            raise ValueError("ticks to capture: not clear; allowed: either `seconds` alone, or `first` with `end`")
        if self.first is not None and self.end is not None and self.end <= self.first:
            raise ValueError(f"end: {self.end}; allowed: above {self.first}, the value of `first`")
        return self


class Span(BaseModel):
    """Time span of a picture, in s since the start of the run; `until` None is the end of the recording."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    from_s: float = Field(default=0.0, ge=0, le=1e9, alias="from")
    until: float | None = Field(default=None, gt=0, le=1e9)


def validate_request(model: type[M], data: object) -> M:
    """Return an instance of the pydantic class `model` with the fields in `data`, JSON bytes or a mapping.

    Raises ValueError that names each invalid value.
    """
    try:
        return model.model_validate_json(data) if isinstance(data, bytes) else model.model_validate(data)
    except ValidationError as error:
        raise ValueError("; ".join(describe(error, "", None))) from None
