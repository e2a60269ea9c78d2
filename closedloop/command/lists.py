"""Lists: ``closedloop scenarios``, and ``closedloop version``."""

from closedloop.command.border import DONE, Parser, as_command


def list_of_scenarios() -> str:
    """Return the names of the shipped scenarios and what each is, a line each."""
    from closedloop.scenario.load import load_scenario, shipped_scenarios

    names = shipped_scenarios()
    width = max(map(len, names))
    return "\n".join(f"{name:{width}}  {load_scenario(name).description}" for name in names)


def versions() -> str:
    """Return the versions of Python and of the packages whose arithmetic a run depends on, on one line."""
    from closedloop.record.save import package_versions

    return ", ".join(f"{name} {version}" for name, version in package_versions().items())


@as_command()
def scenarios(words: list[str]) -> int:
    """List the shipped scenarios, and return the exit status."""
    Parser(
        prog="closedloop scenarios", description="List the shipped scenarios, for `closedloop run NAME`."
    ).parse_args(words)
    print(list_of_scenarios())
    return DONE


@as_command()
def version(words: list[str]) -> int:
    """Print the versions that a run depends on, and return the exit status."""
    Parser(prog="closedloop version", description="Print the versions that a run depends on.").parse_args(words)
    print(versions().replace(", ", "\n"))
    return DONE
