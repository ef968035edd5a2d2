"""Styles: their parameters, sampling, encoding and rewards, independent of environments."""

from coachable.styles.parameters import Choice, Parameter, Setpoint, Weight
from coachable.styles.reward import StyleReward
from coachable.styles.samplers import (
    ContinuousOneHot,
    Mixture,
    OneHot,
    PointMass,
    Product,
    Sampler,
    Shared,
    Uniform,
    UniformChoice,
)
from coachable.styles.space import StyleSpace
from coachable.styles.terms import (
    ChoiceTolerance,
    SetpointTolerance,
    StyleTerm,
    Term,
    WeightedFeature,
    WeightedSum,
    feature,
    weighted_sum,
)
from coachable.styles.tolerance import tolerance
from coachable.styles.validation import StyleRangeWarning
from coachable.styles.view import StyleView

__all__ = [
    "Choice",
    "ChoiceTolerance",
    "ContinuousOneHot",
    "Mixture",
    "OneHot",
    "Parameter",
    "PointMass",
    "Product",
    "Sampler",
    "Setpoint",
    "SetpointTolerance",
    "Shared",
    "StyleRangeWarning",
    "StyleReward",
    "StyleSpace",
    "StyleTerm",
    "StyleView",
    "Term",
    "Uniform",
    "UniformChoice",
    "Weight",
    "WeightedFeature",
    "WeightedSum",
    "feature",
    "tolerance",
    "weighted_sum",
]
