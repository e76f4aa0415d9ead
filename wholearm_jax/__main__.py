"""`python -m wholearm_jax` is the command line."""

from wholearm_jax.cli.app import main

main()
