"""The part of numba's face that this project uses, typed: a compiled function has the type of its Python form."""

from collections.abc import Callable
from typing import Any, TypeVar, overload

_F = TypeVar("_F", bound=Callable[..., Any])

@overload
def njit(function: _F, /) -> _F: ...
@overload
def njit(
    *,
    cache: bool = ...,
    nogil: bool = ...,
    error_model: str = ...,
    fastmath: Any = ...,
    inline: str = ...,
    parallel: bool = ...,
    boundscheck: bool | None = ...,
) -> Callable[[_F], _F]: ...

prange = range
config: Any
types: Any
literal_unroll: Any

def __getattr__(name: str) -> Any: ...
