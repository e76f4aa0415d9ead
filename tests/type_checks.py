"""Annotations are checked when the package's functions are called: shapes by jaxtyping, types by beartype.

`--jaxtyping-packages` in pyproject.toml's options of pytest names this module. An `int` passes for a `float`, as
PEP 484 says.
"""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
