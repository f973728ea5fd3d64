"""The density of a reading beside scipy's, and that it is one."""

import pytest
import scipy.stats
import torch
from torch.testing import assert_close

from torchpose.vision.density import reading_density


@pytest.mark.parametrize(("outliers", "span"), [(0.02, 5.0), (0.3, 2.0)])
def test_it_is_a_normal_and_something_even(outliers, span):
    deviation = torch.randn(4, 5, dtype=torch.float64)
    sigma = 0.1 + torch.rand(5, dtype=torch.float64)
    normal = torch.from_numpy(scipy.stats.norm(0, sigma.numpy()).pdf(deviation.numpy()))
    expected = (1 - outliers) * normal + outliers / span
    assert_close(reading_density(deviation, sigma, outliers, span), expected)
    assert_close(reading_density(deviation, float(sigma[2]), outliers, span)[:, 2], expected[:, 2])


def test_it_sums_to_one_over_the_span():
    place = torch.linspace(-2.5, 2.5, 100_001, dtype=torch.float64)
    assert_close(float(torch.trapezoid(reading_density(place, 0.1, 0.2, 5.0), place)), 1.0, atol=1e-6, rtol=0)


def test_an_unknown_reading_has_no_density():
    density = reading_density(torch.tensor([torch.nan, 0.0]), torch.tensor(1.0), 0.1, 1.0)
    assert density.isnan().tolist() == [True, False]
