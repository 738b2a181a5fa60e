"""The form that composes a task: skill, roles, modifiers, instruction, distractors, parameters; its YAML in step."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import ModifierModel
from roboxim_studio.editing import composition as edits
from roboxim_studio.editing.composition import DISTRACTORS, Composition
from roboxim_studio.panels import markup
from roboxim_studio.panels.editor_forms import by_person
from roboxim_tasks.choices import Choice
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.task_config import MAX_DISTRACTORS

IN, OUT = "- ", "+ "
"""Before an entry that is chosen, which choosing it again leaves out, and before one that is not."""


class TaskForm:
    """Composes one task; `made` is the task that is drawn."""

    def __init__(self, gui: Any, library: ModelLibrary, show_message: Callable[[str], None]) -> None:
        """Build the form in the current container.

        Args:
            gui: The page's inputs.
            library: Objects.
            show_message: Shows why an edit is not possible; empty: it was made.
        """
        self._gui, self._library, self._show_message = gui, library, show_message
        self.made: Composition | None = None
        """The task; none: the chosen one can only be drawn."""
        self._lock = threading.RLock()
        self._parts: list[Any] = []
        self.folder = gui.add_folder("Compose", expand_by_default=False)
        with self.folder:
            self._problem = gui.add_html("")
            self._skill = gui.add_dropdown("Skill", tuple(SKILLS), initial_value="pick_up")
            self._templates = gui.add_text("Instruction", initial_value="", multiline=True, hint="One template a line.")
            self._roles = gui.add_folder("Objects")
            self._parameters = gui.add_folder("Parameters", expand_by_default=False)
            yaml = gui.add_folder("Task YAML", expand_by_default=False)
            with yaml:
                self._yaml = gui.add_html("")
        self._inputs = (self._skill, self._templates, self._roles, self._parameters, yaml)
        self._skill.on_update(by_person(lambda name: self.edit(lambda made: edits.with_skill(made, str(name)))))
        self._templates.on_update(by_person(self._set_templates))

    def open(self, text: str) -> None:
        """Compose a task of its YAML; one that cannot be composed says so."""
        with self._lock:
            try:
                self.made, problem = edits.composed(text), ""
            except RoboximError as error:
                self.made, problem = None, str(error)
            self._problem.content = markup.paragraph(problem, "not-composed")
            for one in self._inputs:
                one.visible = self.made is not None
            self._show(anew=True)

    def edit(self, change: Callable[[Composition], Composition]) -> bool:
        """Change the task; returns whether it was possible. Why it is not is shown, and nothing changes."""
        with self._lock:
            if self.made is None:
                return False
            before = self.made
            try:
                self.made = change(before)
            except RoboximError as error:
                self._show_message(str(error))
                self._show(anew=True)  # no input keeps what was refused
                return False
            self._show_message("")
            self._show(anew=_outline(before) != _outline(self.made))
            return True

    def toggle(self, role: str, model: str) -> bool:
        """Take a model into a role, or out of it; returns whether that is possible."""
        if self.made is None or role not in self.made.roles:
            return False
        models = [str(name) for name in self.made.roles[role].models.values]
        wanted = _toggled(models, model)
        return self.edit(lambda made: edits.with_models(made, role, wanted, self._library))

    # ---------------------------------------------------------------- inputs

    def _show(self, *, anew: bool) -> None:
        """Show what the task says.

        Args:
            anew: Whether the inputs themselves may be others.
        """
        made = self.made
        if made is None:
            return
        self._yaml.content = markup.pre(made.text, "task-yaml")
        if self._skill.value != made.config.skill:
            self._skill.value = made.config.skill
        lines = "\n".join(made.templates)
        if self._templates.value != lines:
            self._templates.value = lines
        if anew:
            for handle in self._parts:
                handle.remove()
            self._parts = []
            with self._roles:
                for role in made.roles:
                    self._role(made, role)
            with self._parameters:
                self._all_parameters(made)

    def _role(self, made: Composition, role: str) -> None:
        folder = self._gui.add_folder(role)
        self._parts.append(folder)
        objects = made.roles[role]
        chosen = [str(name) for name in objects.models.values]
        with folder:
            if role == DISTRACTORS:
                counts = self._gui.add_vector2(
                    "fewest, most", (made.config.distractors.minimum, made.config.distractors.maximum), step=1,
                    min=(0, 0), max=(MAX_DISTRACTORS, MAX_DISTRACTORS),
                )  # fmt: skip
                counts.on_update(
                    by_person(
                        lambda pair: self.edit(lambda made: edits.with_distractors(made, int(pair[0]), int(pair[1])))
                    )
                )
            self._several("models", made.suited(role, self._library), chosen, lambda name: self.toggle(role, name))
            for kind, model in made.modifiers(role, self._library).items():
                self._modifier(made, role, kind, model)

    def _modifier(self, made: Composition, role: str, kind: str, model: ModifierModel) -> None:
        choice = made.roles[role].modifiers.get(kind)

        def change(choice: Choice | None) -> bool:
            return self.edit(lambda made: edits.with_modifier(made, role, kind, choice))

        def toggle(word: str) -> bool:
            wanted = _toggled(chosen, word)
            return change(Choice(values=tuple(wanted)) if wanted else None)

        def span(ends: Any) -> None:
            low, high = sorted(map(float, ends))
            change(Choice(values=(low,)) if low == high else Choice(lower=low, upper=high))

        chosen = [str(word) for word in choice.values] if choice else []
        if isinstance(model.default, str):
            words = made.words(role, kind, self._library)
            self._several(kind, words, chosen, toggle)
            return
        ends = choice.ends if choice else (model.default, model.default)
        lower, upper = (float(end) for end in (ends[0], ends[-1]))
        given = self._gui.add_vector2(f"{kind}, from and to", (lower, upper), step=0.01)
        given.on_update(by_person(span))

    def _several(
        self, label: str, words: Sequence[str], chosen: Sequence[str], toggle: Callable[[str], object]
    ) -> None:
        """Add an input of several words: choosing one takes it in or out; the first entry says what is chosen."""
        summary = ", ".join(chosen) or "default"

        def entries() -> tuple[str, ...]:
            return (summary, *(f"{IN if word in chosen else OUT}{word}" for word in words))

        handle = self._gui.add_dropdown(label, entries(), initial_value=summary)

        def choose(entry: Any) -> None:
            word = str(entry)[len(IN) :]
            if word in words:
                toggle(word)

        handle.on_update(by_person(choose))

    def _all_parameters(self, made: Composition) -> None:
        varied = made.config.arguments
        for name, default in edits.parameter_defaults(made).items():
            if name in varied:
                self._parts.append(self._gui.add_html(markup.paragraph(f"{name}: {edits.shown(varied[name])}")))
                continue
            value = getattr(made.config.parameters, name)
            if isinstance(default, bool):
                handle: Any = self._gui.add_checkbox(name, initial_value=bool(value))
            elif isinstance(default, int | float):
                handle = self._gui.add_number(name, initial_value=float(value), step=0.001)
            else:
                handle = self._gui.add_text(name, initial_value=str(value))
            handle.on_update(by_person(self._setting(name, type(default))))
            self._parts.append(handle)

    def _setting(self, name: str, kind: type) -> Callable[[Any], None]:
        def set_it(value: Any) -> None:
            self.edit(lambda made: edits.with_parameter(made, name, kind(value)))

        return set_it

    def _set_templates(self, text: Any) -> None:
        lines = [line.strip() for line in str(text).splitlines() if line.strip()]
        self.edit(lambda made: edits.with_templates(made, lines))


def _outline(made: Composition) -> object:
    """Return what decides which inputs there are, and what their lists say."""
    roles = {role: (one.models, one.modifiers) for role, one in made.roles.items()}
    return made.config.skill, roles, made.config.arguments, made.config.distractors


def _toggled(chosen: Sequence[str], word: str) -> list[str]:
    return [one for one in chosen if one != word] if word in chosen else [*chosen, word]
