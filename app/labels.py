"""Names that people and other systems choose: of operators, tracks, aircraft types."""

from typing import Annotated

from pydantic import Field

Label = Annotated[
    str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$")
]
