"""Model cards of PAPNet. Literal data: importing this loads no torch."""

from __future__ import annotations

from partialbench.registry import ModelCard, Recipe

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
                "in training carries noise of ±45° on each Euler angle."
            ),
        ),
        published="papnet.published:from_published",
        paper_scores={"pm40": 83.5, "ps15": 91.5, "pm40>ps15": 56.0, "ps15>pm40": 54.6},
        choices=(
            "λ = 1, as released; the noisy pose is snapped to its nearest bin, as released",
            "the ablations are not released. Without pose and multi-task: the class branch reads "
            "the features as they are. Cascaded: a second backbone sees the cloud turned by the "
            "most confident bin; both train together, the pose carrying no gradient of the class. "
            "Input transformation: the turned cloud goes through the same backbone again. "
            "Regression: six numbers, Gram–Schmidt, squared Frobenius distance to the label. "
            "Without vector: 1,024 scalars in place of the pose descriptor's 64 fields a degree",
        ),
        deviations=(
            "symmetry takes the nearest of the whole group; the release's sequence of X-, Y- and "
            "Z-180 misses it for 8.5 % of rotations",
            "a coordinate of exactly +1 cannot leave the grid",
        ),
    ),
)
