import torch

from sb3_crpn.cubic import solve_krylov


def test_a_step_is_one_line():
    step = solve_krylov(torch.ones(2).double(), lambda v: v, 1.0)
    assert str(step) == (
        f"CubicStep(global minimiser: ‖s‖ = {step.step.norm():.3g}, λ = {step.multiplier:.3g}, "
        f"decrease {step.predicted_decrease:.3g}, residual {step.residual:.1e}, "
        f"{step.products} products, certified)"
    )
