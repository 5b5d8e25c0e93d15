"""`pansplat check`: whether the poses of a pair fit its panoramas."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from pansplat.cli.inputs import PairChoice, choose_set
from pansplat.system.console import make_table_console


@dataclass(frozen=True)
class Check:
    """Check that the poses of a pair fit its panoramas; exit status 1 if a mistake is likely."""

    path: Positional[Path]
    """A folder of two or more panoramas with poses."""
    choice: PairChoice = field(default_factory=PairChoice)

    def run(self) -> int:
        """Print how well each interpretation of the poses fits; 1 if another one fits far better."""
        from rich.table import Table

        from pansplat.evaluation.pose_check import AS_GIVEN, check_pair

        check = check_pair(choose_set(self.path, self.choice))
        table = Table(title=f"{check.name}: baseline {check.baseline:.3f} m")
        table.add_column("interpretation of the poses")
        table.add_column("error of the warped view", justify="right")
        for reading, error in check.errors.items():
            style = "bold" if reading == AS_GIVEN else "green" if error < check.error and check.likely_mistake else ""
            table.add_row(reading, f"{error:.3f}", style=style)
        console = make_table_console()
        console.print(table)
        if check.indistinguishable:
            print(f"these views do not distinguish {AS_GIVEN} from: {', '.join(check.indistinguishable)}")
        for warning in check.warnings:
            console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
        if check.likely_mistake:
            console.print(f"likely mistake: {check.likely_mistake}", style="bold red", markup=False, soft_wrap=True)
            return 1
        if not check.can_judge:
            print("undecided: the check says nothing for or against these poses")
        elif check.similar:
            listed = ", ".join(f"{reading} ({check.errors[reading]:.3f})" for reading in check.similar)
            print(f"undecided between {AS_GIVEN} ({check.error:.3f}) and what fits about as well: {listed}")
        else:
            print("no other interpretation of the poses fits as well")
        return 0
