"""`CoachSession`: coach an agent while it acts, without a display; the page and scripts use it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coachable.coach.phrases.grammar import StyleGrammar, Understanding, fitting
from coachable.coach.session.live_controls import LiveControls
from coachable.coach.session.live_episodes import LiveEpisodes
from coachable.coach.session.readout import MeasuredWindow, StyleReport
from coachable.coach.session.recording import Recording, check_seed, is_trained, within_json
from coachable.coach.session.timeline import Timeline
from coachable.domain import Domain
from coachable.styles import Choice, StyleSpace, Weight
from coachable.training.weights import domain_of, load_policy


class CoachSession:
    """One agent in one environment, coached while it acts.

    A request applies from the next observation on: the policy reads the style given to `set` in the following `step`.
    While `hold` is true, the request stays in force when an episode begins; otherwise each episode draws a style as in
    training. After an episode has ended, the next `step` begins a new one; `LiveEpisodes` explains time limits.

    Args:
        policy: Policy that reads `observation` and `style` and writes `action`.
        space: Style space that it was trained on.
        domain: Domain in which it acts.
        source: Where the policy came from; kept in recordings.
        seed: Seed of the initial states and drawn styles.
        style: First request, by parameter name; other parameters have the space's default.
        strict: Whether to raise for a request outside the trained range instead of clamping it with a warning.
        window: Length of the measured window [s]; by default the domain's.

    Attributes:
        policy: The policy; you may replace it between steps.
        presets: Named styles; you may add your own.
        grammar: Grammar that reads the phrases of `say`.
        hold: Whether the request stays in force when an episode begins.

    Example:
        >>> session = CoachSession.open("humanoid", seed=1)
        >>> session.set(pose="t_pose", step_length=0.5)
        >>> transition = session.step()
        >>> session.style["pose"]
        't_pose'
        >>> session.close()
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        space: StyleSpace,
        domain: Domain,
        *,
        source: str = "",
        seed: int = 0,
        style: Mapping[str, float | str] | None = None,
        strict: bool = False,
        window: float | None = None,
    ) -> None:
        self.policy, self.space, self.domain, self.source = policy, space, domain, source
        parameters = [*space.parameters, *(control.parameter for control in domain.controls)]
        words = fitting(domain.words, parameters)
        self.strict, self.hold = strict, True
        self.window = window = domain.window if window is None else window
        self._episodes = LiveEpisodes(domain, space, terminated=words.terminated)
        self.presets: dict[str, dict[str, Any]] = {"default": space.describe(space.default)}
        self.presets |= {name: dict(style) for name, style in words.presets.items()}
        self._controls = LiveControls(domain)
        self.grammar = StyleGrammar(parameters, words.vocabulary, words.examples)
        self._understood: Understanding | None = None
        self._recent = MeasuredWindow(domain.measures, round(window / domain.control_step))
        self._outside: dict[str, float] = {}
        self._theta = space.make(strict=strict, **(style or {}))
        self.reset(seed)

    @classmethod
    def open(cls, source: str | Path, *, env_options: Mapping[str, str] | None = None, **settings: Any) -> CoachSession:
        """Open a session with a trained agent.

        Args:
            source: Name of a domain that ships with weights, a run's folder, a checkpoint or a weights file.
            env_options: Options of the domain's environment as texts, see `Domain.env_options`.
            **settings: Further arguments of the constructor.

        Raises:
            CheckpointError: If there is no such agent, or it is of another version.
            ValueError: If the domain has no such option, or not with such a value.
        """
        agent = load_policy(source)
        domain = domain_of(agent)
        domain = domain.with_options(domain.read_options(env_options or {}))
        return cls(agent.actor, agent.space, domain, source=str(source), **settings)

    @property
    def style(self) -> dict[str, float | str]:
        """The request in force, by parameter name."""
        return self.space.describe(self._theta)

    @property
    def controls(self) -> dict[str, float]:
        """Requested values of the live controls, by name, in their units."""
        return dict(self._controls.wanted)

    def set(self, **values: float | str) -> None:
        """Request another style from the next observation on; parameters that are not named keep their values.

        Args:
            **values: A number for each `Weight` or `Setpoint`, the name of an option for each `Choice`.

        Raises:
            ValueError: For an unknown name or option, for NaN, or in strict mode for a number outside the trained
                range. The request in force then stays.
        """
        theta = self.space.make(strict=self.strict, **(self.style | values))
        self._timeline.take_over()
        self._request(theta, values)

    def apply(self, preset: str) -> None:
        """Request the style of a preset.

        Raises:
            ValueError: If there is no preset of that name.
        """
        self.set(**self._preset(preset))

    def steer(self, **values: float) -> None:
        """Set live controls, as values that those with a rate approach; circular ones wrap around, others are clamped.

        Raises:
            ValueError: For an unknown control or NaN.
        """
        fitted = self._controls.fitted(values)
        self._timeline.take_over()
        self._controls.wanted |= fitted

    def push(self, forward: float = 0.0, left: float = 0.0) -> None:
        """Push the agent before the next step; see `coachable.domain.Push`, whose largest strength limits the push.

        Raises:
            ValueError: If the domain has no push, or a strength is not finite.
        """
        if (push := self.domain.push) is None:
            raise ValueError(f"{self.domain.name} has no push")
        fitted = push.fit(float(forward), float(left))
        self._timeline.take_over()
        self._apply({"push": list(fitted)})

    def say(self, phrase: str) -> Understanding:
        """Request a style in words: "shorter steps, arms up", "0.4 m", "a bit more", or a preset's name.

        Returns:
            Which parts of the phrase were understood; only those are requested.

        Raises:
            ValueError: In strict mode, for a number outside the trained range.
        """
        understood = self.understand(phrase)
        self.follow(understood)
        return understood

    def understand(self, phrase: str) -> Understanding:
        """Return how `say` reads a phrase, without requesting anything; other threads than the loop's may call it."""
        preset = next((name for name in list(self.presets) if name.lower() == phrase.strip().lower()), None)
        if preset is not None:
            return Understanding(phrase, dict(self.presets[preset]), (f"preset {preset}",), ())
        return self.grammar.read(phrase, self.style | self.controls, self._understood)

    def follow(self, understood: Understanding) -> None:
        """Request the changes of an understood phrase; see `say`."""
        style = {name: value for name, value in understood.changes.items() if name in self.space}
        controls = {name: float(value) for name, value in understood.changes.items() if name not in style}
        if style:
            self.set(**style)
        if controls:
            self.steer(**controls)
        self._understood = understood

    def schedule(self, plan: Mapping[float, Mapping[str, float | str] | str]) -> None:
        """Request styles at later times; an earlier plan is replaced.

        Args:
            plan: Style by parameter name, or the name of a preset, by time from now [s].

        Raises:
            ValueError: For a negative time or a style that `set` would refuse; nothing is scheduled then.
        """
        agenda: dict[int, dict[str, Any]] = {}
        for seconds in plan:
            if not isinstance(seconds, int | float) or not 0.0 <= seconds < math.inf:
                raise ValueError(f"the plan has the time {seconds!r}: expected seconds from now on, 0 or more")
        for seconds, style in sorted(plan.items()):
            values = self._preset(style) if isinstance(style, str) else dict(style)
            theta = self.space.make(strict=self.strict, **(self.style | values))
            request = {name: value for name, value in self.space.describe(theta).items() if name in values}
            event = agenda.setdefault(round(min(seconds / self.domain.control_step, 1e18)), {"style": {}, "asked": {}})
            event["style"] |= request
            event["asked"] |= values  # before clamping
        self._timeline.plan(agenda)

    @property
    def scheduled(self) -> int:
        """Number of coming requests of a plan or a replay."""
        return self._timeline.coming

    def cancel(self) -> None:
        """Drop the rest of a plan or replay; the request in force stays."""
        self._timeline.cancel()

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode; the style and the live controls stay, a plan is dropped.

        Args:
            seed: Seed with which the session and its recording start over; None continues both.

        Raises:
            ValueError: If the seed is no whole number, is negative or has more than 63 bits.
        """
        if seed is None:
            self.cancel()
            self._apply({"reset": True})
            return
        check_seed(seed)
        self._controls.values |= self._controls.wanted
        start = Recording(self.domain.name, self.source, seed, self.style, self.controls)
        self._episodes.seed(seed)
        self._timeline = Timeline(start)
        self._steps_at_request, self._complied_at, self.seed = 0, None, seed
        self._generator = torch.Generator().manual_seed(seed)
        self._controls.steer(self.base_env)
        self._begin_episode()

    @property
    def step_count(self) -> int:
        """Number of steps since the session was last seeded."""
        return self._timeline.step

    @property
    def episode(self) -> int:
        """Number of the episode, from 1."""
        return self._episodes.number

    @torch.no_grad()
    def step(self) -> TensorDictBase:
        """Make one control step with the request in force.

        Returns:
            The transition as `env.step` returns it, batch shape (1,).

        Raises:
            ReplayMismatch: If a replay differs from its recording; later steps are not compared.
        """
        for event in self._timeline.due():
            self._apply(event)
        if changes := self._controls.approached(self.domain.control_step):
            self._apply({"controls": changes})
        if self.ended is not None:
            self._begin_episode()
        transition = self._episodes.step(self.policy, self._theta)
        self._recent.add(transition)
        if self._complied_at is None and self._recent.complies():
            self._complied_at = self.step_count + 1
        self._timeline.advance(self._episodes.observation)
        return transition

    def run(self, seconds: float, on_step: Callable[[CoachSession], None] = lambda _: None) -> None:
        """Make steps for some simulated time.

        Args:
            seconds: Simulated time [s].
            on_step: Called with this session after each step.

        Raises:
            ValueError: If the time is negative or not finite.
        """
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f"seconds = {seconds}: expected 0 or more")
        for _ in range(round(seconds / self.domain.control_step)):
            self.step()
            on_step(self)

    def report(self) -> StyleReport:
        """Return requested and measured style over the window, which restarts with each request and episode."""
        summary = self._recent.summary()
        return StyleReport(
            requested=self.style,
            measured={name: value for name, value in summary.items() if math.isfinite(value)},
            unmeasured=tuple(name for name, value in summary.items() if not math.isfinite(value)),
            seconds=len(self._recent) * self.domain.control_step,
            outside=dict(self._outside),
            asks=any(not isinstance(p, Weight) or self.style[p.name] for p in self.space.parameters),
            complying=self._recent.complying(),
            needs=self._recent.needs,
            complied_after=None if self._complied_at is None else self._seconds(self._complied_at),
            since_request=self._seconds(self.step_count),
            episode=self._episodes.number,
            episode_time=self._episodes.steps * self.domain.control_step,
            ended=self.ended,
            endings=dict(self._episodes.endings),
        )

    @property
    def ended(self) -> str | None:
        """Why the episode is over, or None while it runs."""
        return self._episodes.ended

    @property
    def env(self) -> EnvBase:
        """The environment, of batch size 1, with its style transforms."""
        return self._episodes.env

    @property
    def base_env(self) -> EnvBase:
        """The domain's environment without the transforms around it."""
        return self._episodes.base_env

    def replica(self) -> CoachSession:
        """Open another session of the same agent, in a new environment."""
        return CoachSession(self.policy, self.space, self.domain, source=self.source, window=self.window)

    def close(self) -> None:
        """Release the environment."""
        self._episodes.close()

    def recording(self) -> Recording:
        """Return a copy of the recording since the session was last seeded."""
        return self._timeline.recording(self._episodes.observation)

    def replay(self, recording: Recording) -> None:
        """Start over as recorded with the same agent; the next `recording.steps` steps repeat the session bit for bit.

        A request, a changed control or a reset ends the replay.

        Raises:
            ValueError: If the recording belongs to another domain, style space or set of controls; the session is
                then unchanged.
        """
        recording.check(self.domain.name, self.space, self._controls.controls, self.domain.push)
        self._theta, self._outside = self.space.make(strict=True, **recording.style), {}
        self._controls.change(recording.controls, settled=True)
        self.reset(recording.seed)
        self._timeline.repeat(recording)

    @property
    def replaying(self) -> bool:
        """Whether a replay is running; false after its last step."""
        return self._timeline.replayed is not None

    def _preset(self, name: str) -> dict[str, Any]:
        if name not in self.presets:
            raise ValueError(f"no preset named {name!r}: expected one of {list(self.presets)}")
        return self.presets[name]

    def _apply(self, event: Mapping[str, Any]) -> None:
        """Apply an event now and record it."""
        if "style" in event:
            self._request(self.space.make(**(self.style | event["style"])), event.get("asked", event["style"]))
        if "controls" in event:
            self._controls.change(event["controls"], settled=self.replaying)  # a recording has all of the way
            self._controls.steer(self.base_env)
            self._timeline.note({"controls": dict(event["controls"])})
        if self.domain.push is not None and "push" in event and self.ended is None:
            self.domain.push.apply(self.base_env, *event["push"])
            self._timeline.note({"push": list(event["push"])})
        if "reset" in event:
            self._timeline.note({"reset": True})
            self._begin_episode()

    def _request(self, theta: Tensor, asked: Mapping[str, Any]) -> None:
        """Put a style in force and record it; `asked` are the requested values before clamping."""
        numbers = {name: within_json(v) for name, v in asked.items() if not isinstance(self.space[name], Choice)}
        values = {**self._outside, **numbers}.items()
        self._outside = {name: value for name, value in values if not is_trained(self.space[name], value)}
        before, self._theta = self.style, theta
        changed = {name: value for name, value in self.style.items() if value != before[name]}
        if changed:
            self._steps_at_request, self._complied_at = self.step_count, None
            self._recent.clear()
            self._timeline.note({"style": changed})

    def _begin_episode(self) -> None:
        # The first episode has the requested style; a replay has recorded the styles that were drawn.
        if not self.hold and self._episodes.number and not self.replaying:
            drawn = self.space.sample((), self._generator)
            self._request(drawn, self.space.describe(drawn))
        self._episodes.begin(self._theta)
        self._recent.clear()

    def _seconds(self, step: int) -> float:
        return (step - self._steps_at_request) * self.domain.control_step
