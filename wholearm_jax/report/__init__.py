"""The HTML page of a result folder."""

from wholearm_jax.report.page import report
