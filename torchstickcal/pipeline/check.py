"""Do the given lenses and clocks agree with the keypoints? What they would be if they were unknown, from one linearisation.

At the solution the reduced camera system is built with a column for every unknown of every camera. Any choice of unknowns, own
or shared, is then a small system in which the other columns are left out. The decrease of the cost that it promises says how
strongly the keypoints ask for this choice.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.geometry.singular import covariance_of, solve_information
from torchstickcal.lazy import cached_property
from torchstickcal.model.correlation import ErrorCorrelation, error_correlation
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns, all_unknowns, clock_refinements, with_refinements
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.folds import Fold, folds_of_frames, folds_of_points
from torchstickcal.solvers import Termination, ignore_record
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.gauss_newton import gauss_newton
from torchstickcal.solvers.uncertainty import camera_covariance, likelihood

_CHECKED_FRAMES = 5000
_SIGMAS = 4.0
_STEPS = 8
"""Most steps to the least cost with all lenses and clocks unknown."""
_FRAME_FOLDS, _POINT_FOLDS = 8, 3
"""Parts of the frames and of the points that in turn take no part in finding what is refined, and judge it."""
_PRICE = 4.0
"""Decrease of the cost that each further unknown has to bring, in units of a squared standard deviation; chance brings 1."""
_ALIKE = 0.05
"""Relative difference of the decreases of the cost up to which two choices explain the keypoints equally well."""
_STRAIGHT_FRAMES = 0.25
"""Time over which the motion of the keypoints may be taken as straight."""
_FEW_PARTS = 6.0
"""By how much a variance that only the scatter between the parts of the frames shows has to be larger to be as sure as one that
is known: as Student's distribution of seven degrees of freedom demands at four standard deviations."""
_LARGEST_LOSS = 0.1
"""What a choice may lose in the parts of the frames that it makes fit worse, as a share of what it gains in the others."""


class Suggestion(NamedTuple):
    """What an unknown would be by the keypoints, as a deviation from the present value, everything else being as it is."""

    deviation: Tensor
    """(C, n)"""
    std: Tensor
    """(C, n)"""


class Solution(NamedTuple):
    """What some unknowns would be by the keypoints, everything else being unknown as it is."""

    unknowns: RigUnknowns
    values: Tensor
    """(K,)"""
    covariance: Tensor
    """(K, K)"""


class _System(NamedTuple):
    """The reduced camera system of one session, with a column for every unknown of every camera."""

    cameras: Intrinsics
    every: RigUnknowns
    state: State
    objective: Objective
    information: Tensor
    gradient: Tensor
    gradient_covariance: Tensor
    """that of the gradient, the information itself where errors of the keypoints do not last"""

    @staticmethod
    def of(part: Adjustment, variants: tuple[str, ...], groups: Sequence[str]) -> _System:
        """That of a session where it has ended, with some variant of every unknown."""
        result, sigma_px = part.last, part.last.sigma_px
        kept = part.exposures.at_common_times(part.seen, part.state, part.support).keeping(result.inliers)
        cameras = kept.cameras_at(part.state).to(torch.float64)
        every = RigUnknowns.of(variants, cameras, groups)
        state = replace(part.state, unknowns=every.given)
        objective = likelihood(_with_every_unknown(kept, part.state, every), part.last_camera_stage.losses, sigma_px)
        system = NormalEquations(objective, state, cameras_free=True)
        information = gradient_covariance = system.reduced[0]
        correlation = _unexplained_correlation(objective, state, sigma_px)
        if correlation.lasts:
            gradient_covariance = information @ camera_covariance(objective, state, correlation)[0] @ information
        return _System(cameras, every, state, objective, information, system.reduced_gradient[0], gradient_covariance)

    @property
    def poses(self) -> int:
        """Number of the unknowns of the cameras' poses, which come first."""
        return len(self.gradient) - self.every.count


class CameraCheck:
    """One session's cameras at a solution, examined as if their lenses and clocks were unknown, when first asked.

    Args:
        adjustment: one session where it has ended. Of a long one the middle is examined.
        groups: a label for each camera; cameras with the same label share what is shared.
    """

    def __init__(self, adjustment: Adjustment, groups: Sequence[str]) -> None:
        self._adjustment, self._groups = adjustment, groups
        self._choices: dict[tuple[str, ...], tuple[Tensor, RigUnknowns]] = {}
        self._solutions: dict[tuple[str, ...], Solution] = {}
        self._variants = {unknown.name: next(iter(unknown.variants)) for unknown in all_unknowns().values()}

    @cached_property
    def _system(self) -> _System:
        return _System.of(self._adjustment.within(_CHECKED_FRAMES), tuple(self._variants.values()), self._groups)

    def suggestion(self, name: str) -> Suggestion:
        """What the keypoints suggest for an unknown by itself, by its name."""
        return self._suggestions[name]

    @cached_property
    def _suggestions(self) -> dict[str, Suggestion]:
        """For each unknown, as if there were no other: by the blocks on the diagonal of the system of all."""
        columns = self._system.every.columns.values()
        return self._suggested(torch.cat([torch.full_like(own, number) for number, own in enumerate(columns)]))

    def suggestion_of_one(self, name: str) -> Suggestion:
        """What the keypoints suggest for an unknown of each camera, as if it were that of this camera alone."""
        return self._suggested(torch.arange(self._system.every.count, device=self._system.gradient.device))[name]

    def _suggested(self, block: Tensor) -> dict[str, Suggestion]:
        """What is suggested where the unknowns of one block (K,) are unknown together, the others as given."""
        every, (information, gradient, gradient_covariance) = self._system.every, self._without_poses
        alone = information.where(block == block[:, None], 0.0)
        values, covariance = -solve_information(alone, gradient), covariance_of(alone)
        if gradient_covariance is not None:
            covariance = covariance @ gradient_covariance @ covariance
        variances = every.variances(covariance)
        return {
            name: Suggestion(deviation[0], variances[name].sqrt()) for name, deviation in every.by_name(values[None]).items()
        }

    def tangents_by(self, name: str, deviation: float) -> Tensor:
        """Covariance (6 (C - 1), 6 (C - 1)) of the cameras' tangents by errors of given values that nothing tells.

        Args:
            name: of an unknown that was not refined. It is wrong in each camera by itself, and the poses, and what was refined,
                give way.
            deviation: standard deviation of the error, in its own unit.
        """
        system, refined = self._system, set(self._adjustment.refined)
        columns = {own: system.poses + column for own, column in system.every.columns.items()}
        giving_way = [columns[unknown.name] for unknown in all_unknowns().values() if refined & set(unknown.variants)]
        poses = torch.arange(system.poses, device=system.gradient.device)
        free = torch.cat([poses, *(column.to(poses.device) for column in giving_way)])
        response = covariance_of(system.information[free][:, free]) @ system.information[free][:, columns[name]]
        return deviation**2 * (response @ response.mT)[: system.poses, : system.poses]

    def suggestion_for_all(self, variant: str) -> tuple[Tensor, Tensor]:
        """What the keypoints suggest for an unknown that cameras share, by its variant: values (K,) as deviations, and their
        standard deviations (K,)."""
        _, values, covariance = self._solved((variant,))
        return values, covariance.diagonal().sqrt()

    def wanted(
        self, allowed: Collection[str], refined: Sequence[str] = (), failed: Sequence[tuple[str, ...]] = ()
    ) -> tuple[str, ...]:
        """The refinements beside those made that are worth a trial; none where the cameras agree with the keypoints.

        Of the choices that explain the keypoints about equally well, and better than all others, it is the one with the fewest
        unknowns. A worse explanation is never taken instead: it would be an excuse for what the better one says. The choice
        has to be needed and to predict (:meth:`confirms`).

        Args:
            allowed: what may be refined.
            refined: the refinements made.
            failed: refinements that were tried and rejected; after them only parts of them are tried.
        """
        gains: dict[tuple[str, ...], float] = {}
        for names in _choices():
            added = with_refinements(refined, names)
            if set(names) <= set(allowed) and added != tuple(refined) and all(set(added) < set(other) for other in failed):
                gains[names] = self._gain(names)
        clear, best = _SIGMAS**2, max(gains.values(), default=0.0)
        least = max(clear, best - max(clear, _ALIKE * best))
        alike = [names for names, gain in gains.items() if gain > least]
        for names in sorted(alike, key=lambda names: (len(self._solved(names).values), -gains[names])):
            if self._is_needed(names) and self._predicts(names):
                return names
        return ()

    def may_be_far_in_time(self, allowed: Collection[str]) -> bool:
        """Whether the keypoints ask for clocks so far off that the motion is not straight; how far is then not known here.

        Args:
            allowed: what may be refined.
        """
        for names in _choices():
            if set(names) <= set(allowed) & clock_refinements() and self._gain(names) > _SIGMAS**2:
                unknowns, values, _ = self._solved(names)
                offsets = [values[columns] for name, columns in unknowns.columns.items() if name == "time_offset"]
                if any(bool((own.abs() > _STRAIGHT_FRAMES).any()) for own in offsets):
                    return True
        return False

    def confirms(self, names: tuple[str, ...], deviations: Mapping[str, Tensor]) -> bool:
        """Whether a choice that has been refined here is needed and predicts.

        Needed: its values are far from those given, and so are those of each unknown, beyond chance and the usual errors of
        calibrations. Predicts: found without some frames or some points, it makes these fit better.

        Args:
            names: the choice.
            deviations: (C, n), from the given values, by the name of the unknown.
        """
        own = {name: deviation[None] for name, deviation in deviations.items()}
        values = self._solved(names).unknowns.of_cameras(own)[0]
        return self._is_needed(names, values) and self._predicts(names, values)

    def _gain(self, names: tuple[str, ...]) -> float:
        """Squared length of a choice's values in their standard deviations, less a price for each of its unknowns.

        Where the errors of the keypoints are independent, it is the decrease of the cost that the choice promises.
        """
        solution = self._solved(names)
        return _gain(solution.values, solution.covariance)

    def _is_needed(self, names: tuple[str, ...], values: Tensor | None = None) -> bool:
        """Whether a choice's values are far from those given, by what the parts of the frames say of their uncertainty.

        That holds for all values together, and for those of each unknown, given the usual errors of calibrations.

        Args:
            names: the choice.
            values: (K,), None for those that the keypoints suggest.
        """
        unknowns, suggested, covariance = self._solved(names)
        covariance, values = self._inflation(names) * covariance, suggested if values is None else values
        if _gain(values, covariance) <= _SIGMAS**2:
            return False
        usual = covariance + unknowns.usual_sigma[0].square().diag()
        return all(_is_far(values[own], usual[own][:, own]) for own in unknowns.columns.values())

    def _inflation(self, names: tuple[str, ...]) -> float:
        """How much larger a choice's variances may be than those stated, by the scatter between parts of the frames.

        Errors that several points or cameras have in common in a frame are alike. That is seen here, not in any point's track.
        A few parts do not show a variance well, so what they add to the stated one counts more.
        """
        folds, _ = self._folds
        if not folds:
            return 1.0
        chosen, covariance = self._chosen(names), self._solved(names).covariance
        without = torch.stack([solve_information(*self._without(fold, chosen)) for fold in folds])[:, -len(covariance) :]
        jackknife = (len(folds) - 1) * without.var(0, correction=0)
        ratio = float((jackknife / covariance.diagonal()).mean())
        return 1.0 + _FEW_PARTS * max(0.0, ratio - 1.0)

    def _predicts(self, names: tuple[str, ...], values: Tensor | None = None) -> bool:
        """Whether a choice, found without some frames or without some points, makes these fit better, beyond doubt.

        Args:
            names: the choice.
            values: (K,), at which the cameras are; None for those given.
        """
        values = torch.zeros_like(self._solved(names).values) if values is None else values
        of_frames, of_points = ([self._gain_on(fold, names, values) for fold in folds] for folds in self._folds)
        if of_frames:
            gains = torch.stack(of_frames)
            if float(-gains.clamp_max(0).sum()) > _LARGEST_LOSS * float(gains.clamp_min(0).sum()):
                return False
        return all(_certain(torch.stack(gains)) for gains in (of_frames, of_points) if gains)

    def _gain_on(self, fold: Fold, names: tuple[str, ...], values: Tensor) -> Tensor:
        """Decrease of a fold's cost by a choice that was found without it, beyond that by the poses at the given values.

        Args:
            fold: the part of the keypoints.
            names: the choice.
            values: (K,), at which the cameras are.
        """
        chosen, poses = self._chosen(names), self._system.poses
        information, gradient = self._without(fold, chosen)
        moved = gradient[:poses] - information[:poses, poses:] @ values
        given = torch.cat([-solve_information(information[:poses, :poses], moved), -values])

        def decrease(step: Tensor) -> Tensor:
            step = chosen @ step
            return -step @ (2 * fold.gradient + fold.information @ step)

        return decrease(-solve_information(information, gradient)) - decrease(given)

    def _without(self, fold: Fold, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """The system of poses and a choice's unknowns of all keypoints but a fold's."""
        information, gradient = self._system.information - fold.information, self._system.gradient - fold.gradient
        return chosen.mT @ information @ chosen, chosen.mT @ gradient

    @cached_property
    def _folds(self) -> tuple[list[Fold], list[Fold]]:
        """Parts of the keypoints: frames one after another, and groups of points."""
        objective, state = self._system.objective, self._system.state
        blocks = [frames for frames in _blocks(objective.measurements.frames, _FRAME_FOLDS) if frames.stop > frames.start]
        of_frames = folds_of_frames(objective, state, blocks)
        of_points = folds_of_points(objective, state, _point_groups(objective))
        return of_frames if len(of_frames) > 1 else [], of_points if len(of_points) > 1 else []

    def _solved(self, names: tuple[str, ...]) -> Solution:
        """A choice's unknowns, their values and their covariance."""
        if names in self._solutions:
            return self._solutions[names]
        (every, gradient, gradient_covariance), (picked, unknowns) = self._without_poses, self._picked(names)
        information = picked.mT @ every @ picked
        values, covariance = -solve_information(information, picked.mT @ gradient), covariance_of(information)
        if gradient_covariance is not None:
            covariance = covariance @ picked.mT @ gradient_covariance @ picked @ covariance
        self._solutions[names] = Solution(unknowns, values, covariance)
        return self._solutions[names]

    @cached_property
    def _without_poses(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """The system of all unknowns from which the poses are eliminated: information, gradient, and the covariance of the
        gradient where that is not the information."""
        system, poses = self._system, self._system.poses
        with_poses = system.information[poses:, :poses]
        unknowns = torch.eye(len(with_poses)).to(with_poses)
        map_to = torch.cat([-with_poses @ covariance_of(system.information[:poses, :poses]), unknowns], dim=1)
        lasting = system.gradient_covariance is not system.information
        gradient_covariance = map_to @ system.gradient_covariance @ map_to.mT if lasting else None
        return map_to @ system.information[:, poses:], map_to @ system.gradient, gradient_covariance

    def _chosen(self, names: tuple[str, ...]) -> Tensor:
        """The map from poses and a choice's unknowns to poses and all unknowns."""
        picked, _ = self._picked(names)
        return torch.block_diag(torch.eye(self._system.poses).to(picked), picked)

    def _picked(self, names: tuple[str, ...]) -> tuple[Tensor, RigUnknowns]:
        """The map from a choice's unknowns to all unknowns, and the choice's unknowns."""
        if names in self._choices:
            return self._choices[names]
        system = self._system
        unknowns = RigUnknowns.of(names, system.cameras, self._groups)
        every = [(unknown.name, component) for unknown in system.every.unknowns for component in unknown.components]
        chosen = [(unknown.name, component) for unknown in unknowns.unknowns for component in unknown.components]
        picked = unknowns.share.new_zeros(len(unknowns.share), len(every), unknowns.count)
        picked[:, [every.index(component) for component in chosen]] = unknowns.share
        means = system.every.share / system.every.share.sum((0, 1))
        self._choices[names] = means.flatten(0, 1).mT @ picked.flatten(0, 1), unknowns
        return self._choices[names]


def _with_every_unknown(kept: Measurements, state: State, every: RigUnknowns) -> Measurements:
    """Measurements with more unknowns, which are zero where the cameras are as a state has them."""
    assert kept.motion is not None
    return replace(
        kept,
        pixels=kept.pixels_at(state),
        cameras=kept.cameras_at(state).to(torch.float64),
        unknowns=every,
        motion=kept.motion._replace(reference=every.given),
    )


def _blocks(frames: int, count: int) -> list[slice]:
    """Frames in blocks of about equal length, one after another."""
    bounds = [frames * number // count for number in range(count + 1)]
    return list(map(slice, bounds[:-1], bounds[1:]))


def _point_groups(objective: Objective) -> list[Tensor]:
    """Masks (N,) of groups of points that no loss couples: sticks, which set the scale, are never left out. Often empty."""
    m = objective.measurements
    coupled = {point for cluster in objective.clusters for point in cluster}
    single = [point for point in range(m.points_per_frame) if point not in coupled]
    if len(single) < 2 * _POINT_FOLDS:
        return []
    groups = m.confidence.new_zeros(_POINT_FOLDS, m.points_per_frame, dtype=torch.bool)
    for number, group in enumerate(groups):
        group[single[number::_POINT_FOLDS]] = True
    return [group.repeat(m.frames) for group in groups]


def _gain(values: Tensor, covariance: Tensor) -> float:
    """Squared length of values (K,) in their standard deviations, less a price for each."""
    return float(values @ solve_information(covariance, values)) - _PRICE * len(values)


def _is_far(values: Tensor, covariance: Tensor) -> bool:
    """Whether all values (K,) together, or one of them alone, are clearly not zero."""
    largest = float((values.square() / covariance.diagonal()).max()) - _PRICE
    return max(largest, _gain(values, covariance)) > _SIGMAS**2


def _certain(gains: Tensor) -> bool:
    """Whether the mean of some gains is above zero by more than its standard error."""
    return float(gains.mean()) > float(gains.std()) / len(gains) ** 0.5


def _unexplained_correlation(objective: Objective, state: State, sigma_px: Tensor) -> ErrorCorrelation:
    """The correlation of the errors that no lens and no clock explains: near the least cost with all of them unknown."""
    correlation = error_correlation(objective.measurements, state, sigma_px)
    if not correlation.lasts:
        return correlation
    outcome = gauss_newton(
        objective, state, cameras_free=True, termination=Termination(_STEPS), stage="check", listener=ignore_record
    )
    return error_correlation(objective.measurements, outcome.state, sigma_px)


def _choices() -> Iterator[tuple[str, ...]]:
    """What ``auto`` compares: every combination of the unknowns of one family, each in any of its variants."""
    for family in ("clock", "lens"):
        variants = [
            [None, *unknown.variants]
            for unknown in all_unknowns().values()
            if unknown.family == family and unknown.tried_by_auto
        ]
        for names in itertools.product(*variants):
            if any(names):
                yield tuple(name for name in names if name is not None)
