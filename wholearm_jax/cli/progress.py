"""Progress bars on the terminal (standard error)."""


def count_progress(text: str):
    """Return a progress bar that counts, with its task's fields in the format string `text` and the time left."""
    from rich.progress import TextColumn, TimeElapsedColumn, TimeRemainingColumn

    return _progress(
        TextColumn("{task.completed}/{task.total}"), TextColumn(text), TimeElapsedColumn(), TimeRemainingColumn()
    )


def solver_progress():
    """Return progress bars for solvers, each with its task's field `state`; their time left is not known."""
    from rich.progress import TextColumn, TimeElapsedColumn

    return _progress(TextColumn("{task.fields[state]}"), TimeElapsedColumn())


def _progress(*columns):
    """Return named progress bars followed by `columns`."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    return Progress(TextColumn("{task.description}"), BarColumn(), *columns, console=Console(stderr=True))
