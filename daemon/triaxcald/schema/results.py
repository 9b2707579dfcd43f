"""What `results` prints with ``--json`` (`triaxcal.results/1`)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, create_model

import triaxcal as tc
from triaxcald.schema.columns import COLUMNS, Column, Kind

TYPES: dict[Kind, Any] = {Kind.TEXT: str, Kind.TEXTS: list[str], Kind.WHOLE: int, Kind.NUMBER: tc.schema.Figure}


def _field(column: Column) -> Any:
    kind = TYPES[column.kind]
    return Annotated[kind if column.required else kind | None, Field(description=column.meaning)], ...


Row: type[tc.schema.Model] = create_model(
    "Row", __base__=tc.schema.Model, __module__=__name__, **{column.name: _field(column) for column in COLUMNS}
)
Counts = dict[str, int]


class Results(tc.schema.Model):
    """The runs in a folder, in the order of their start."""

    format: Annotated[Literal["triaxcal.results/1"], Field(description="format of this document")]
    folder: Annotated[tc.schema.Text, Field(description="the folder")]
    verdicts: Annotated[Counts, Field(description="number of runs, by verdict")]
    codes: Annotated[Counts, Field(description="number of runs, by code; runs without a code are not counted")]
    skipped: Annotated[
        list[tc.schema.Text],
        Field(description="names of files `*.outcome.json` in the folder that are no outcome, or cannot be read"),
    ]
    runs: Annotated[
        list[Row],
        Field(description="the runs, by start; by end where there is no start. `null` where the outcome has no value"),
    ]
