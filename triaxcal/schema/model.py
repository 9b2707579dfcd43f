"""The base of the models of documents, and the values that they have in common."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Self, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)

E = TypeVar("E", bound=StrEnum)


def _as_given(value: Any, handler: ValidatorFunctionWrapHandler) -> float:
    """The value itself once it is found sound: pydantic would take
    `triaxcal.rounding.Printed` for a plain float, and an audit needs what it
    carries."""
    checked = handler(value)
    return value if isinstance(value, float) else checked


def _any_text(value: Any, handler: ValidatorFunctionWrapHandler) -> str:
    """With the surrogates that stand for bytes of a file name that are no
    UTF-8: pydantic would refuse them, and whoever shows or writes the text
    replaces them or says so."""
    return value if isinstance(value, str) else handler(value)


Text = Annotated[str, WrapValidator(_any_text)]
"""Text that may quote the name of a file or the words of a command."""
Figure = Annotated[float, WrapValidator(_as_given)]
"""A finite number, rounded as documents have it."""
Word = Annotated[E, Field(strict=False), PlainSerializer(str)]
"""A word out of a list. Documents hold it as text."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Figures = list[Figure | None]
"""A number that does not exist is `null`."""
Vector = Annotated[list[Figure], Field(min_length=3, max_length=3)]
"""Of x, y, z."""
Matrix = Annotated[list[Vector], Field(min_length=3, max_length=3)]
"""Row by row."""


class Model(BaseModel):
    """A document or a part of one. The keys are in the order in which they are
    written; one that was not given is not written. Reading ignores keys that a
    later version added.

    A key with a default is one that documents of some kind, or of an earlier
    version, do without.
    """

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    def document(self) -> dict[str, Any]:
        return self.model_dump(exclude_unset=True, by_alias=True)

    @classmethod
    def read(cls, value: object) -> Self | None:
        """None where the value, of JSON, is no such document."""
        try:
            return cls.model_validate(value) if isinstance(value, Mapping) else None
        except ValidationError:
            return None
