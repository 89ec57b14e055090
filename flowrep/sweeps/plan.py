"""The plan of a sweep before Hydra begins: its folder, and its runs if they are known."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from flowrep.config import UsageError
from flowrep.config.composition import Preview
from flowrep.config.flags import only_shows
from flowrep.config.run_names import run_of_sweep


@dataclass(frozen=True)
class Plan:
    """A sweep to start or continue.

    Args:
        folder: the folder that holds a folder for each run.
        total: the number of runs, None if only the sweeper knows it.
        names: names of the runs' folders, empty if a sweeper such as Optuna's chooses them.
        options: overrides of the chosen plugins that a sweep needs and that were not typed.
    """

    folder: Path
    total: int | None
    names: tuple[str, ...]
    options: tuple[str, ...] = ()

    def folders(self) -> list[Path]:
        """Returns the folders of its runs, only the existing ones if a sweeper names them."""
        if self.names:
            return [self.folder / name for name in self.names]
        return sorted(path for path in self.folder.glob("*/") if (path / "job.log").exists())


def is_sweep(arguments: Sequence[str]) -> bool:
    """Returns whether a command line asks for several runs, and not only shows their config."""
    args = get_args_parser().parse_args([*arguments])
    modes = [text for text in args.overrides if text.startswith("hydra.mode=")]
    return not only_shows(args) and (args.multirun or modes[-1:] == ["hydra.mode=MULTIRUN"])


def plan_of(config_name: str, arguments: Sequence[str]) -> Plan:
    """Returns the sweep that a valid command line asks for.

    Args:
        config_name: a file of conf/, without its ending.
        arguments: as typed.

    Raises:
        UsageError: it would continue one run, or two of its runs would share a folder.
    """
    args = get_args_parser().parse_args([*arguments])
    preview = Preview(args, config_name)
    try:
        parsed = preview.with_sweepers(preview.parse(args.overrides))
        if any(override.key_or_group == "resume" for override in parsed):
            raise UsageError(
                "resume= continues one run; continue a sweep with its own command and "
                "hydra.sweep.dir=<its folder>"
            )
        hydra = preview.hydra_config(parsed)
        folder = Path(hydra.sweep.dir).absolute()
        typed = {override.key_or_group for override in parsed}
        options = tuple(o for o in _plugin_options(hydra) if o.partition("=")[0] not in typed)
        if _class_of(hydra.sweeper) != BasicSweeper.__name__:
            return Plan(folder, OmegaConf.select(hydra, "sweeper.n_trials"), (), options)
        ours = [o for o in parsed if not o.key_or_group.startswith(("hydra.", "hydra/"))]
        (jobs,) = BasicSweeper.split_arguments(ours, None)
    finally:
        GlobalHydra.instance().clear()
    names = tuple(run_of_sweep(job) for job in jobs)
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise UsageError(f"two runs would share the folder {twice[0]}: is a value repeated?")
    return Plan(folder, len(names), names, options)


_OPTIONS = {
    # finished jobs take no time, so batches would grow and delay the unfinished ones
    "JoblibLauncher": ("hydra.launcher.batch_size=1",),
    # a run returns its success, and a failed run should not end the study
    "OptunaSweeper": ("hydra.sweeper.direction=maximize", "hydra.sweeper.max_failure_rate=1.0"),
}


def _plugin_options(hydra: DictConfig) -> tuple[str, ...]:
    return sum((_OPTIONS.get(_class_of(hydra[part]), ()) for part in ("launcher", "sweeper")), ())


def _class_of(plugin: DictConfig) -> str:
    return str(plugin["_target_"]).rpartition(".")[2]
