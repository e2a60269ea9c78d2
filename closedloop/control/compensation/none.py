"""No compensation of friction."""

from __future__ import annotations

from closedloop.control.law import Compensation


class NoCompensation(Compensation):
    """[compensation] kind = "none": friction is not compensated."""
