"""Linear subspaces of silhouettes (T. 4.2): principal and independent components, and the crop before them.

Letters: n images, D pixels, m components.
"""

from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class Crop(Enum):
    """What part of the image is resized. Lower-case names, as Hydra reads an enum by its member's name."""

    person = "person"  # the silhouette's box, widened to the target's shape: drops place and size
    image = "image"  # the whole image


@dataclass(frozen=True)
class SilhouetteConfig:
    """The small image that a silhouette becomes."""

    height: int = 32  # px
    width: int = 24  # px
    crop: Crop = Crop.person  # person or image

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise ValueError(f"silhouette size must be at least 1 x 1 px, got {self.height} x {self.width}")


def resize_silhouettes(
    silhouettes: Float[Tensor, "frames height width"] | Bool[Tensor, "frames height width"],
    config: SilhouetteConfig = SilhouetteConfig(),
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "frames rows columns"]:
    """Crop and shrink by exact area: each value is the share of its rectangle that is foreground.

    An image without foreground (> 0.5), or with a NaN, gives NaN. What a crop takes from beyond the image is
    background. Float silhouettes keep their dtype, boolean ones take `dtype`.
    """
    images = silhouettes if silhouettes.is_floating_point() else silhouettes.to(dtype)
    height, width = images.shape[1:]
    foreground = images > 0.5
    lost = ~foreground.flatten(1).any(1) | images.isnan().flatten(1).any(1)
    if config.crop is Crop.image:
        top, left = images.new_zeros(len(images)), images.new_zeros(len(images))
        bottom, right = top + height, left + width
    else:
        top, bottom = _extent(foreground.any(2), images.dtype)
        left, right = _extent(foreground.any(1), images.dtype)
        # Widen the short side about its middle: a person with the arms out must not be squeezed.
        pixel = torch.maximum((bottom - top) / config.height, (right - left) / config.width)
        middle, half = (top + bottom) / 2, pixel * config.height / 2
        top, bottom = middle - half, middle + half
        middle, half = (left + right) / 2, pixel * config.width / 2
        left, right = middle - half, middle + half
    rows = _overlap(top, bottom, config.height, height)
    columns = _overlap(left, right, config.width, width)
    small = rows @ images @ columns.transpose(1, 2)
    return torch.where(lost[:, None, None], torch.nan, small)


def _extent(
    hit: Bool[Tensor, "frames pixels"], dtype: torch.dtype
) -> tuple[Float[Tensor, " frames"], Float[Tensor, " frames"]]:
    """Near edge of the first hit pixel, far edge of the last (pixel i covers i to i + 1); 0, 1 with none."""
    first = hit.to(torch.uint8).argmax(1)
    last = hit.shape[1] - hit.flip(1).to(torch.uint8).argmax(1)
    found = hit.any(1)
    return torch.where(found, first, 0).to(dtype), torch.where(found, last, 1).to(dtype)


def _overlap(
    near: Float[Tensor, " frames"], far: Float[Tensor, " frames"], cells: int, pixels: int
) -> Float[Tensor, "frames cells pixels"]:
    """Weights that average pixels into equal cells from `near` to `far`: each pixel's share of a cell."""
    size = ((far - near) / cells)[:, None, None]
    start = near[:, None, None] + size * torch.arange(cells, device=near.device, dtype=near.dtype)[:, None]
    pixel = torch.arange(pixels, device=near.device, dtype=near.dtype)
    shared = torch.minimum(start + size, pixel + 1) - torch.maximum(start, pixel)
    return shared.clamp(min=0) / size


@dataclass(frozen=True)
class PCA:
    """The mean image and the orthonormal rows of E_PCA, greatest variance first."""

    mean: Float[Tensor, " pixels"]
    components: Float[Tensor, "components pixels"]
    variance: Float[Tensor, " components"]


# From here on iterating is several times faster than all eigenvectors, of which only a few are wanted.
_LARGE, _FEW = 1000, 0.2  # least side of the data; share of it that is wanted
_SPARE = 50  # directions more than wanted: those sought converge the faster
_SETTLED = 2e-4  # stop when another round should lower the squared error by less than this share
_ROUNDS = 20


def pca(images: Float[Tensor, "images pixels"], num_components: int) -> PCA:
    """Principal components (4.2, 4.3); fewer than asked for where the images span fewer.

    Few of many come from subspace iteration, filtered by Chebyshev polynomials of degree 2 (Zhou and Saad, 2007), until
    the reconstruction would hardly gain, all others from the eigenvectors of the smaller of the covariance (D, D) and
    the Gram matrix (n, n). Each is turned so that its greatest entry is positive.

    Raises:
        ValueError: fewer than two images that differ.
    """
    mean = images.mean(0)
    centered = images - mean
    least = min(images.shape)
    if least >= _LARGE and num_components <= _FEW * least:
        values, components = _leading(centered, num_components)
    else:
        values, components = _all_eigenvectors(centered)
    # Rounding leaves eigenvalues of about eps times the greatest where the true ones are 0.
    floor = values[0] * torch.finfo(images.dtype).eps * max(images.shape)
    rank = min(int((values > floor).sum()), len(images) - 1)
    if rank < 1:
        raise ValueError(f"PCA needs at least two images that differ, got {len(images)} that do not")
    keep = min(num_components, rank)
    values, components = values[:keep], components[:keep]
    components = components / torch.linalg.vector_norm(components, dim=1, keepdim=True)
    greatest = components.gather(1, components.abs().argmax(1, keepdim=True))
    return PCA(mean, components * greatest.sign(), values / len(images))


def _all_eigenvectors(
    centered: Float[Tensor, "images pixels"],
) -> tuple[Float[Tensor, " directions"], Float[Tensor, "directions pixels"]]:
    """Sums of squares along the principal directions, greatest first, and these, of any length."""
    by_gram = len(centered) < centered.shape[1]
    # In double precision: pixels that never change make many eigenvalues 0, where LAPACK's single may fail.
    squares = (centered @ centered.T if by_gram else centered.T @ centered).double()
    values, vectors = (part.to(centered.dtype).flip(-1) for part in torch.linalg.eigh(squares))
    return values, (centered.T @ vectors if by_gram else vectors).T


def _leading(
    centered: Float[Tensor, "images pixels"], wanted: int
) -> tuple[Float[Tensor, " wanted"], Float[Tensor, "wanted pixels"]]:
    """The same of the greatest directions alone. The start is drawn anew in the same way each time."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(wanted + _SPARE, len(centered), generator=generator).to(centered)
    basis = torch.linalg.qr((start @ centered).T).Q
    total, before = float(centered.square().sum()), float("inf")
    for _ in range(_ROUNDS):
        projected = centered @ basis
        values, vectors = torch.linalg.eigh((projected.T @ projected).double())
        error = total - float(values[-wanted:].sum())
        # The filter is at most 1 up to the least value of the spare directions, and this at the last wanted one.
        cut = float(values[0])
        if cut <= 0:
            break
        passed = 2 * (2 * float(values[_SPARE]) / cut - 1) ** 2 - 1
        if (before - error) / passed**2 <= _SETTLED * error:
            break
        before = error
        once = centered.T @ projected * (2 / cut) - basis
        twice = centered.T @ (centered @ once) * (4 / cut) - 2 * once - basis
        basis = torch.linalg.qr(twice).Q
    values, vectors = values.to(centered.dtype).flip(0), vectors.to(centered.dtype).flip(1)
    return values[:wanted], (basis @ vectors[:, :wanted]).T


@dataclass(frozen=True)
class ICA:
    """W: `unmixing @ signals` are independent, of variance 1."""

    unmixing: Float[Tensor, "components signals"]
    iterations: int
    converged: bool


def fast_ica(
    signals: Float[Tensor, "signals samples"],
    start: Float[Tensor, "signals signals"],
    iterations: int = 200,
    tolerance: float = 1e-4,
) -> ICA:
    """Symmetric FastICA with g = tanh (Hyvarinen, 1999) on whitened signals.

    Args:
        signals: mixtures, one a row. The whitening drops what the others determine, which leaves fewer
            components than signals.
        start: any matrix of full rank, W's start in the whitened space.
        tolerance: stop when every row of W turns by less: 1 - |cosine| between rounds.
    """
    samples = signals.shape[1]
    centered = signals - signals.mean(1, keepdim=True)
    covariance = (centered @ centered.T / samples).double()
    values, vectors = (part.to(signals.dtype) for part in torch.linalg.eigh(covariance))
    kept = values > values[-1] * torch.finfo(signals.dtype).eps * max(signals.shape)
    whitening = vectors[:, kept].T / values[kept].sqrt()[:, None]
    white = whitening @ centered
    rank = len(white)

    unmixing, converged, rounds = _decorrelate(start[:rank, :rank]), False, 0
    while rounds < iterations and not converged:
        rounds += 1
        response = (unmixing @ white).tanh()
        slope = (1 - response.square()).mean(1, keepdim=True)
        turned = _decorrelate(response @ white.T / samples - slope * unmixing)
        converged = bool((1 - (turned * unmixing).sum(1).abs()).max() < tolerance)
        unmixing = turned
    return ICA(unmixing @ whitening, rounds, converged)


def _decorrelate(matrix: Float[Tensor, "rows rows"]) -> Float[Tensor, "rows rows"]:
    """(W W^T)^-1/2 W, the nearest matrix with orthonormal rows."""
    values, vectors = torch.linalg.eigh(matrix @ matrix.T)  # a third of an SVD's time
    return vectors / values.clamp(min=torch.finfo(values.dtype).tiny).sqrt() @ vectors.T @ matrix
