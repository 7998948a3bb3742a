"""Command lines, as they are typed."""


def pat(line: str, *more: object) -> None:
    """Run `pat` with the words of a line, and with `more` of them, which may have spaces."""
    from pat.app.cli.main import main

    main([*line.split(), *map(str, more)])


def images(folder, *names: str) -> str:
    """The option that gives each camera its PNG file of a folder."""
    return " ".join(f"--image {name}={folder / name}.png" for name in names)
