"""Annotations are checked when the package's functions are called: shapes by jaxtyping, types by beartype.

`.ci/run` names this module in pytest's option `--jaxtyping-packages`. An `int` passes for a `float`, as PEP 484 says.
What pydantic hands to a validator is a protocol that cannot be checked at run time.
"""

from beartype import BeartypeConf, FrozenDict, beartype
from pydantic import ValidationInfo

checked = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict({ValidationInfo: object})))
