"""What a run says of itself: its verdict, the paper's five assumptions, and how large every error was."""

from closedloop.record.report.measures import NEAR_SINGULAR, RESIDUAL_TOLERANCE
from closedloop.record.report.summary import assumptions, energy_balance, summarise
from closedloop.record.report.tables import notes, print_report, report_rows

__all__ = [
    "NEAR_SINGULAR", "RESIDUAL_TOLERANCE", "assumptions", "energy_balance", "notes", "print_report", "report_rows",
    "summarise",
]  # fmt: skip
