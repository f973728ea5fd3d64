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


def pca(images: Float[Tensor, "images pixels"], num_components: int) -> PCA:
    """Principal components (4.2, 4.3); fewer than asked for where the images span fewer.

    The eigenvectors come from the smaller of the covariance (D, D) and the Gram matrix (n, n). Each is turned
    so that its greatest entry is positive.

    Raises:
        ValueError: fewer than two images that differ.
    """
    mean = images.mean(0)
    centered = images - mean
    by_gram = len(images) < images.shape[1]
    # In double precision: pixels that never change make many eigenvalues 0, where LAPACK's single may fail.
    squares = (centered @ centered.T if by_gram else centered.T @ centered).double()
    values, vectors = (part.to(images.dtype) for part in torch.linalg.eigh(squares))
    # Rounding leaves eigenvalues of about eps times the greatest where the true ones are 0.
    floor = values[-1] * torch.finfo(images.dtype).eps * max(images.shape)
    rank = min(int((values > floor).sum()), len(images) - 1)
    if rank < 1:
        raise ValueError(f"PCA needs at least two images that differ, got {len(images)} that do not")
    keep = min(num_components, rank)
    values, vectors = values[-keep:].flip(0), vectors[:, -keep:].flip(1)
    components = (centered.T @ vectors if by_gram else vectors).T
    components = components / torch.linalg.vector_norm(components, dim=1, keepdim=True)
    greatest = components.gather(1, components.abs().argmax(1, keepdim=True))
    return PCA(mean, components * greatest.sign(), values / len(images))


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
    left, _, right = torch.linalg.svd(matrix)
    return left @ right
