"""Least squares by GTSAM's optimisers: Gauss-Newton, and Levenberg-Marquardt where steps must be damped.

By QR: Cholesky stalls and throws where a stiff IMU meets weak fixes, in short drives and outages.
"""

import gtsam

QR = "MULTIFRONTAL_QR"


def minimise(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, is_bound: bool, limit: int, tolerance: float
) -> tuple[gtsam.Values, int]:
    """The values of least cost, and the number of iterations; `limit` if they are not found.

    They are found when the cost changes by less than `tolerance` of itself. Undamped steps are tried first, but not in
    a graph that relative poses bind (`is_bound`): in some of its directions a centimetre costs less than the tolerance.
    Raises RuntimeError where the equations have no solution.
    """
    found = None if is_bound else _gauss_newton(graph, start, limit, tolerance)
    return found or _levenberg_marquardt(graph, start, limit, tolerance)


def _gauss_newton(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    limit: int,
    tolerance: float,
    may_grow: bool = False,
) -> tuple[gtsam.Values, int] | None:
    """Undamped steps, until one gains what the linear graph says; None where the cost grows, or there is no step.

    Where the two agree to `tolerance` of the cost, the next step would hardly gain more: it need not be made to see it.
    """
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType(QR)
    optimiser = gtsam.GaussNewtonOptimizer(graph, start, params)
    values, first = start, optimiser.error()
    cost = first
    try:
        for iteration in range(1, limit):
            linear, before, cost = optimiser.iterate(), cost, optimiser.error()
            if not (may_grow or cost <= before):
                return None
            # a copy: the optimiser drops its values at the next step
            here, values = values, gtsam.Values(optimiser.values())
            expected = linear.error(here.zeroVectors()) - linear.error(here.localCoordinates(values))
            if abs(before - cost - expected) <= tolerance * cost and cost <= first:
                return values, iteration
    except RuntimeError:  # a graph that only damping makes regular
        return None
    return None


def _levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, limit: int, tolerance: float
) -> tuple[gtsam.Values, int]:
    """Damped steps; where damping makes them crawl, undamped ones from there, whatever they cost on the way."""
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType(QR)
    params.setMaxIterations(limit)
    params.setRelativeErrorTol(tolerance)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
    values, iterations = optimiser.optimize(), optimiser.iterations()
    if iterations < limit:
        return values, iterations
    return _gauss_newton(graph, values, limit, tolerance, may_grow=True) or (values, limit)
