"""Run a study: `python -m goalgan_bt.study point_umaze`."""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # while it imports, nothing has begun
    leave_at_once()

import time

from goalgan_bt.runs.command_line import check_ranges, parse, run_command
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.terminal import complain, say
from goalgan_bt.study.execute import finished
from goalgan_bt.study.plan import StudyConfig, grid, load
from goalgan_bt.study.tables import Tables


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError: saying what is wrong with it, or what is left to do.
    """
    cfg = parse(StudyConfig, argv, "python -m goalgan_bt.study")
    check_ranges(cfg)
    try:
        from goalgan_bt.study import report
    except ImportError:
        raise UsageError(
            'the report needs matplotlib and scipy: pip install "goalgan_bt[study]"'
        ) from None
    study = load(cfg.study)
    tables = Tables(cfg.out / study.name, study.measure)
    missing = [run for run in grid(study) if not tables.has(run)]
    failed = 0
    if missing and not cfg.report:
        say(f"{study.name}: {len(missing)} runs of {len(grid(study))} to go")
        began = time.monotonic()
        places = cfg.runs / study.name
        for i, (run, job) in enumerate(finished(cfg, missing, places), 1):
            try:
                last = tables.add(run, job.result())
            except Exception as error:  # whatever became of one run, the others go on
                failed += 1
                complain((str(error).strip().splitlines() or [type(error).__name__])[-1])
                continue
            left = (time.monotonic() - began) / i * (len(missing) - i) / 60
            say(
                f"{time.strftime('%H:%M:%S')} {i}/{len(missing)} {run.env} {run.method} "
                f"s{run.seed}: {study.measure} {last:.3f}  left {left:.0f} min"
            )
    if not tables.costs:
        raise UsageError(f"{tables.folder} holds no finished run yet: run the study first")
    report.report(study, tables)
    say(str(tables.folder / "README.md"))
    if failed:
        raise RunError(f"{failed} runs failed: the same command tries them again")


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv), lambda: "the same command goes on with what is missing")


if __name__ == "__main__":
    exit_with(main())
