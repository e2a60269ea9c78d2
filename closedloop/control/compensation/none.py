"""No compensation of friction."""

from closedloop.control.law import Compensation


class NoCompensation(Compensation):
    """[compensation] kind = "none": friction is not compensated."""
