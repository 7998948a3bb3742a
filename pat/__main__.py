"""`python -m pat` is `pat`: torchrun starts it so."""

from .cli import main

main()
