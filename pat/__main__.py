"""`python -m pat` is `pat`: torchrun starts it so."""

from .cli.main import main

main()
