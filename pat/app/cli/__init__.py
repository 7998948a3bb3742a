"""The commands of `pat`: `main` finds the one that is named, and a module holds each family of them."""
