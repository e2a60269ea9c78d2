"""Packages that a run does not need, and the extras of this package that install them."""

from importlib.util import find_spec

from closedloop.base.errors import ScenarioError

# By the name that Python imports: what the package is for, and its extra.
EXTRAS = {
    "pyarrow": ("tables of runs", "tables"),
    "pandas": ("data frames", "tables"),
    "xarray": ("datasets of xarray", "tables"),
}


def needs(*packages: str) -> None:
    """Refuse what needs packages that are not installed."""
    for package in packages:
        if find_spec(package) is None:
            raise ScenarioError(_line(package))


def not_installed(error: BaseException) -> str:
    """Return the line for an import that failed for want of one of `EXTRAS`, "" for any other error."""
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    return _line(package) if package in EXTRAS else ""


def missing_line(what: str, package: str, extra: str) -> str:
    """Return the line that something needs a package, and how to install it: `what` ends with its verb."""
    return f'{what} {package}, which is not installed: pip install "closedloop[{extra}]"'


def _line(package: str) -> str:
    what, extra = EXTRAS[package]
    return missing_line(f"{what} need", package, extra)
