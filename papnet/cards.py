"""Model cards of PAPNet. Literal data: importing this loads no torch."""

from __future__ import annotations

from partialbench.registry import ModelCard, Recipe

_POINTS = "pc (1024×3)"

_STEERED_RECIPE = Recipe(
    optimizer="adamw",
    lr=3e-3,
    weight_decay=0.01,
    batch_size=32,
    epochs=60,
    schedule="one-cycle",
    notes="This project's own. No augmentation but the protocol's.",
)

# Cross entropy without smoothing, as the loss of papnet-steered is.
_STEERED_COMMON = {"label_smoothing": 0.0}

_STEERED_ENCODER = (
    "invariant features of each point: two layers over its 16 nearest neighbours and one over what "
    "they give, on distances, cosines and local steerable moments; no coordinate enters a weight",
    "no rank decides anything: neighbours fade out before the one that ends a neighbourhood, so "
    "that rounding cannot undo the equivariance",
    "the wider neighbourhood, a quarter of the points but at most 128, is seen through moments of "
    "harmonics and three shells of the distance",
)

CARDS: tuple[ModelCard, ...] = (
    ModelCard(
        name="papnet",
        entry="papnet.model:PAPNet",
        title="PAPNet",
        paper="Xu et al., Classification of Single-View Object Point Clouds, arXiv:2012.10042v2",
        reference="TerenceHsu666/PAPNet@878adcc; mariogeiger/se3cnn@546bc68",
        representation="voxel (1×64³)",
        invariances=frozenset({"permutation"}),
        parameters={40: 1_154_874, 15: 1_151_649},
        recipe=Recipe(
            optimizer="adam",
            lr=0.005,
            batch_size=32,
            epochs=20,
            schedule="step",
            schedule_options={"gamma": 0.1, "milestones": (10, 15)},
            notes=(
                "Published without augmentation of the cloud; the pose given to the class branch "
                "in training carries noise of ±45° on each Euler angle. The release tests after "
                "every epoch and keeps the last."
            ),
        ),
        # Its loss is its own: cross entropy without smoothing.
        common={"label_smoothing": 0.0},
        published="papnet.published:from_published",
        published_options={"limit": 0.0},
        paper_scores={"pm40": 83.5, "ps15": 91.5, "pm40>ps15": 56.0, "ps15>pm40": 54.6},
        choices=(
            "λ = 1, as released; the noisy pose is snapped to its nearest bin, as released, after "
            "which it is off by 50.6° on average (snap=false)",
            "as released, pooling samples at even places, so that a volume's centre moves by 3/8 "
            "of a cell at 16³ and a half turn of a blob is off by 46 %; upsampling does not move "
            "it back; an ensemble compares raw logits; both heads read averaged vectors and are "
            "not invariant; and what is turned is turned about the visible points' centroid",
            "the ablations are not released. Without pose and multi-task: the class branch reads "
            "the features as they are. Cascaded: a second backbone sees the cloud turned by the "
            "most confident bin; both train together, the pose carrying no gradient of the class. "
            "Input transformation: the turned cloud goes through the same backbone again, in "
            "training as one batch with the clouds as they came. "
            "Regression: six numbers, Gram–Schmidt, squared Frobenius distance to the label. "
            "Without vector: 1,024 scalars in place of the pose descriptor's 64 fields a degree",
        ),
        deviations=(
            "symmetry takes the nearest of the whole group; the release's sequence of X-, Y- and "
            "Z-180 misses it for 8.5 % of rotations",
            "the published PS15 labels are not mapped by any symmetry; here a scanned instance, "
            "of ScanNet or of the simulated rooms, has its Scan2CAD symmetry, which maps them",
            "a coordinate of exactly +1 cannot leave the grid",
            "at test a field that is beyond 32 times its mean square of training in some cloud is "
            "scaled down to that; as released, a few clouds have logits of millions "
            "(--option limit=0)",
        ),
    ),
    ModelCard(
        name="papnet-steered",
        entry="papnet.steered.model:PAPNetSteered",
        title="PAPNet, steered",
        paper="This project's own; the idea is Xu et al.'s, arXiv:2012.10042v2",
        representation=_POINTS,
        invariances=frozenset({"permutation"}),
        parameters={40: 985_064, 15: 977_239},
        recipe=_STEERED_RECIPE,
        common=_STEERED_COMMON,
        choices=(
            *_STEERED_ENCODER,
            "the descriptor: 96 channels of every degree up to 3, point features pooled against "
            "harmonics of the direction from the centroid and against the local moments",
            "one hidden layer of 312 reads the descriptor turned to each of 360 poses, the 60 bins "
            "and the rotations farthest from them, together with the norms of its channels, and "
            "scores (pose, class) jointly; the class is the sum over poses, the pose the sum over "
            "classes",
            "loss: CE of the class + 0.3 · CE of the joint with a soft pose under the symmetry "
            "map, e^(6·cos θ) at the angle θ from the label",
        ),
    ),
    ModelCard(
        name="papnet-steered-nopose",
        entry="papnet.steered.model:PAPNetSteeredNoPose",
        title="PAPNet, steered, without pose",
        paper="This project's own: the pose-free twin of papnet-steered",
        representation=_POINTS,
        invariances=frozenset({"permutation", "rotation"}),
        parameters={40: 989_386, 15: 979_761},
        recipe=_STEERED_RECIPE,
        common=_STEERED_COMMON,
        choices=(
            *_STEERED_ENCODER,
            "the encoder and descriptor of papnet-steered; the norms of its channels, which no "
            "rotation changes, go through two hidden layers of as many parameters as its head",
            "norms do not change under reflection either: it cannot tell a shape from its mirror "
            "image, which papnet-steered can",
        ),
    ),
)
