"""Commands of `pat`: `main` runs the one that is named; each module holds a family of them."""
