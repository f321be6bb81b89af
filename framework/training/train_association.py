"""Training of the learned association on synthetic rooms with simulated detectors.

`python -m framework.training.train_association OUT` writes OUT, a file for `fuser.association_weights`, and reports
accuracy and log-loss on held-out rooms. It takes about 20 minutes on one core. Equal seeds give equal weights.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file
from torch import Tensor
from tqdm import tqdm

from framework.data import Bool, Float32, Float64, Int32
from framework.files.atomic_write import atomic_write
from framework.mapping.instances.association import Association, match_one_to_one
from framework.mapping.instances.learned_association import FEATURES, AssociationScorer, shapes
from framework.training.association_samples import Sample, record_room, stacked

HELD_OUT = 1_000_000  # number of the first held-out room
ROOMS, HELD_OUT_ROOMS = 28, 8
FRAMES = 60  # number of frames of a room
EPOCHS = 60
BATCH = 32  # number of frames of a step
LEARNING_RATE = 3e-3  # maximum learning rate of AdamW
WEIGHT_DECAY = 1e-2
DROPPED = 0.1  # probability that a feature is 0 in all pairs of a step, so that no feature is indispensable


@dataclass(frozen=True)
class Quality:
    """Accuracy and mean log-loss of the decisions on held-out rooms, for the network and the default rule.

    Before matching, each cluster has its best decision. After one-to-one matching, one of two clusters of an object is
    wrong, because it creates another instance.
    """

    decisions: int
    accuracy: float  # of the network before matching
    accuracy_of_rule: float  # of the rule before matching
    matched_accuracy: float  # of the network after one-to-one matching
    matched_accuracy_of_rule: float  # of the rule after one-to-one matching
    log_loss: float
    log_loss_of_rule: float  # of the rule before matching, given its error rate


def initial_weights(seed: int) -> dict[str, Tensor]:
    """Return random weights of the network by name."""
    generator = torch.Generator().manual_seed(seed)
    weights = {}
    for name, shape in shapes().items():
        scale = 0.0 if name.endswith("bias") or name == "offset" else (2 / shape[0]) ** 0.5
        weights[name] = (scale * torch.randn(shape, generator=generator)).requires_grad_()
    return weights


def attention(hidden: Tensor, query: Tensor, group: Tensor, count: int) -> Tensor:
    """Return the mean (count, D) of the rows of each group, weighted by a softmax over the group."""
    score = hidden @ query
    largest = torch.full((count,), -torch.inf).scatter_reduce(0, group, score.detach(), "amax")
    weight = (score - largest[group]).exp()
    sums = torch.zeros(count, hidden.shape[1]).index_add(0, group, hidden * weight[:, None])
    return sums / torch.zeros(count).index_add(0, group, weight).clamp(min=1e-12)[:, None]


def log_odds(w: Mapping[str, Tensor], features: Tensor, cluster: Tensor, instance: Tensor) -> Tensor:
    """Return the log-odds (P,) of each pair against a new instance, as `AssociationScorer.scores`."""
    counts = int(cluster.max()) + 1, int(instance.max()) + 1
    hidden = torch.relu(features @ w["pair.weight"] + w["pair.bias"])
    of_cluster = attention(hidden, w["of_cluster"], cluster, counts[0])
    of_instance = attention(hidden, w["of_instance"], instance, counts[1])
    inputs = torch.cat([hidden, of_cluster[cluster], of_instance[instance]], dim=1)
    match = torch.relu(inputs @ w["match.weight"] + w["match.bias"]) @ w["match.score"]
    new = torch.relu(of_cluster @ w["new.weight"] + w["new.bias"]) @ w["new.score"]
    return match + w["offset"] - new[cluster]


def log_losses(score: Tensor, cluster: Tensor, is_correct: Tensor, new_is_correct: Tensor) -> Tensor:
    """Return the negative logarithm of the probability of a correct decision, for each cluster with pairs."""
    count = len(new_is_correct)
    limited = score.clamp(-30, 30).exp()
    total = torch.ones(count).index_add(0, cluster, limited)
    correct = new_is_correct.float().index_add(0, cluster, limited * is_correct)
    decided = torch.unique(cluster)
    return total[decided].log() - correct[decided].clamp(min=1e-13).log()


def tensors(samples: Sequence[Sample]) -> tuple[Tensor, ...]:
    """Return the result of `stacked` as tensors."""
    features, *rest = stacked(samples)
    return torch.from_numpy(features.astype(np.float32)), *(torch.from_numpy(one) for one in rest)


def fit(samples: Sequence[Sample], seed: int, epochs: int = EPOCHS) -> dict[str, Float32]:
    """Train the network on samples and return its weights by name."""
    weights = initial_weights(seed)
    optimizer = torch.optim.AdamW(weights.values(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    steps = epochs * -(-len(samples) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps)
    rng = np.random.default_rng(seed)
    for _ in tqdm(range(epochs), desc="training", unit="epoch", disable=None):
        order = rng.permutation(len(samples))
        for first in range(0, len(samples), BATCH):
            batch = [samples[k] for k in order[first : first + BATCH]]
            features, cluster, instance, is_correct, new_is_correct = tensors(batch)
            kept = torch.from_numpy((rng.uniform(size=len(FEATURES)) >= DROPPED).astype(np.float32))
            score = log_odds(weights, features * kept, cluster, instance)
            loss = log_losses(score, cluster, is_correct, new_is_correct).mean()
            optimizer.zero_grad()
            torch.autograd.backward(loss)
            optimizer.step()
            schedule.step()
    return {name: weight.detach().numpy() for name, weight in weights.items()}


def rule(sample: Sample) -> tuple[Bool, Float64]:
    """Return the pairs (N, M) that the default rule with extend_score=0 allows, and their IoUs, which it prefers."""
    cluster, instance, features = sample.pairs.clusters, sample.pairs.instances, sample.pairs.features
    allowed, iou = np.zeros(sample.shape, np.bool_), np.zeros(sample.shape)
    allowed[cluster, instance] = features[:, :2].max(axis=1) > Association.min_overlap  # relative to the smaller
    iou[cluster, instance] = features[:, 2]
    return allowed, iou


def match_best(allowed: Bool, preference: Float64) -> Int32:
    """Return the allowed column (N,) with the largest preference of each row, -1 = none. Rows can share a column.

    Args:
        allowed: A Boolean array (N, M), True for pairs that can match.
        preference: The preference (N, M) of each pair.
    """
    if not allowed.size:
        return np.full(len(allowed), -1, np.int32)
    best = np.where(allowed, preference, -np.inf).argmax(axis=1)
    return np.where(allowed.any(axis=1), best, -1).astype(np.int32)


def quality(scorer: AssociationScorer, samples: Sequence[Sample]) -> Quality:
    """Return the quality of the network and of the default rule."""
    right, count = np.zeros(4, np.int64), 0
    losses: list[Float64] = []
    for sample in samples:
        score = scorer.scores(sample.pairs, sample.shape)
        choices = [
            match(*given) for match in (match_best, match_one_to_one) for given in ((score > 0, score), rule(sample))
        ]
        right += [sample.correct_decisions(chosen) for chosen in choices]
        count += len(sample.decided)
        _, cluster, _, is_correct, new_is_correct = tensors([sample])
        of_pair = torch.from_numpy(score[sample.pairs.clusters, sample.pairs.instances])
        losses.append(log_losses(of_pair.float(), cluster, is_correct, new_is_correct).numpy())
    accuracies = [float(one) / count for one in right]
    p = min(max(accuracies[1], 1e-6), 1 - 1e-6)
    return Quality(
        decisions=count,
        accuracy=accuracies[0],
        accuracy_of_rule=accuracies[1],
        matched_accuracy=accuracies[2],
        matched_accuracy_of_rule=accuracies[3],
        log_loss=float(np.concatenate(losses).mean()),
        log_loss_of_rule=float(-p * np.log(p) - (1 - p) * np.log(1 - p)),
    )


def save_weights(path: Path, weights: Mapping[str, Float32], card: Mapping[str, float]) -> None:
    """Write the weights to a file, with a model card in its metadata."""
    metadata = {"features": json.dumps(FEATURES), "card": json.dumps(dict(card))}
    with atomic_write(path) as temporary:
        save_file({name: np.ascontiguousarray(weight) for name, weight in weights.items()}, temporary, metadata)


def train(path: Path, seed: int, rooms: int = ROOMS, held_out: int = HELD_OUT_ROOMS, frames: int = FRAMES) -> Quality:
    """Record samples in synthetic rooms, train the network, write its weights and return its quality.

    Args:
        path: The output file.
        seed: The seed of the initial weights and of the order of the frames.
        rooms: The number of training rooms.
        held_out: The number of held-out rooms.
        frames: The number of frames of a room.
    """
    torch.set_num_threads(1)  # sums of several threads have no fixed order
    samples = recorded(range(rooms), frames, vary=True)
    weights = fit(samples, seed)
    scorer = AssociationScorer({name: weight.astype(np.float64) for name, weight in weights.items()})
    found = quality(scorer, recorded(range(HELD_OUT, HELD_OUT + held_out), frames, vary=False))
    save_weights(path, weights, {"seed": seed, "rooms": rooms, "frames": len(samples), **asdict(found)})
    return found


def recorded(rooms: Sequence[int], frames: int, vary: bool) -> list[Sample]:
    """Return the samples of rooms."""
    progress = tqdm(rooms, desc="mapping rooms", unit="room", disable=None)
    return [sample for room in progress for sample in record_room(room, frames, vary=vary)]


def main() -> None:
    """Train the network from the command line."""
    parser = argparse.ArgumentParser(description="Train the network of fuser.association=LEARNED on synthetic rooms.")
    parser.add_argument("out", type=Path, help="output file")
    parser.add_argument("--seed", type=int, default=0, help="seed of the weights and the order of the frames")
    parser.add_argument("--rooms", type=int, default=ROOMS, help="number of training rooms")
    parser.add_argument("--held-out", type=int, default=HELD_OUT_ROOMS, help="number of held-out rooms")
    arguments = parser.parse_args()
    print(json.dumps(asdict(train(arguments.out, arguments.seed, arguments.rooms, arguments.held_out)), indent=1))


if __name__ == "__main__":
    main()
