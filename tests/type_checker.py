"""The run-time type checker of the tests: an int passes where a float is annotated, as for mypy."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
