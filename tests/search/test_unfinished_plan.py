"""A first plan that DDP did not finish."""

from types import SimpleNamespace

from grounded.search.improve import LATEST, _slowly


def test_how_slowly_an_unfinished_plan_still_improves_is_told():
    """It "stopped after 1000 iterations, still improving", by how much nobody said."""
    costs = [2.0, *(1.0 - 1e-4 * k for k in range(LATEST))]
    plan = SimpleNamespace(trace=[SimpleNamespace(cost=cost) for cost in costs])
    assert _slowly(plan) == f" (the last {LATEST} by 1.0 %)"
    assert _slowly(SimpleNamespace(trace=plan.trace[:5])) == ""
