"""What can go wrong in `factor_graphs`: the measurements, or the estimation."""


class FactorGraphError(Exception):
    """Any error that this package raises on purpose."""


class MeasurementError(FactorGraphError, ValueError):
    """The data given cannot be used: shape, order, span or content."""


class EstimationError(FactorGraphError, RuntimeError):
    """The data are usable, but no trustworthy trajectory came out of them."""


class RepairWarning(UserWarning):
    """Rows of a log were dropped or sorted; the message says how many, and why."""
