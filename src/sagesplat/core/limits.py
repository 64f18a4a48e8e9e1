"""Numbers and texts with limits, as annotations of fields: what is read from files is checked against them.

NaN and infinite numbers are within none of them.
"""

from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

LARGEST = 1e30  # numbers of models; those of fits are far smaller
Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0, le=LARGEST)]
Share = Annotated[float, Meta(ge=0, le=1)]
SomeShare = Annotated[float, Meta(gt=0, le=1)]
Fov = Annotated[float, Meta(ge=1, le=150)]  # degrees
Screen = Annotated[float, Meta(ge=0.01, le=100)]  # focal length in pixels over the photos'

if TYPE_CHECKING:
    NumberOrNaN = float
else:

    class _IsFloat(type):
        def __instancecheck__(cls, value: object) -> bool:
            return isinstance(value, float)

    class NumberOrNaN(float, metaclass=_IsFloat):
        """A number, or NaN, which is null in JSON (`io.typed` reads it so)."""


Whole = Annotated[int, Meta(ge=1 - 2**53, le=2**53 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**53 - 1)]  # of anything, bytes included
AtLeast1 = Annotated[int, Meta(ge=1, le=2**53 - 1)]
StepNumber = Annotated[int, Meta(ge=0, le=2**31 - 1)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
LabelId = Annotated[int, Meta(ge=-1, le=2**15 - 1)]  # -1: unlabelled
CategoryId = Annotated[int, Meta(ge=0, le=2**15 - 1)]

Text = Annotated[str, Meta(max_length=4096)]
Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
