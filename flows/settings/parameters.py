"""A survey's settings as the parameters of a flow: a field for each declared setting, for Prefect's form and checks."""

from __future__ import annotations

from dataclasses import MISSING, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, create_model, model_validator

from flows.settings.documents import about, shown
from flows.settings.load import SURVEY, TABLES, Declared, anchor_paths, load_settings
from flows.settings.survey_settings import AUTO, BUILT_IN_SCENES, Settings
from pipeline.errors import PipelineError

OF_LISTS = {"bands": list[int], "wavelengths": list[float], "size": list[int]}  # also as text: 0-3,7
SECRET = ("password",)  # is read from the settings file alone: a server keeps parameters


def _field(name: str, one: Declared) -> tuple[Any, Any]:
    """Return type and description of a setting as JSON knows it; None is its default."""
    plain = one.kind if one.kind in (bool, int, float, str) or one.choices else OF_LISTS.get(name)
    kind: Any = str | float | int if plain is None else plain | str if name in OF_LISTS else plain
    default = one.item.default
    usual = "" if default is None or default is MISSING else f"; {shown(one)} by default"
    return kind | None, Field(default=None, description=about(one, choices=False) + usual)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", protected_namespaces=())


def _model_of(name: str, fields: dict[str, Any], about: str) -> Any:
    make: Any = create_model  # whose overloads cannot tell fields by name
    return make(name, __base__=_Strict, __doc__=about, **fields)


def _table(name: str) -> Any:
    """Return the model of a table of settings."""
    described = SURVEY[name].item.metadata["description"]
    fields = {key: _field(key, one) for key, one in TABLES[name].items() if key not in SECRET}
    made = _model_of(f"{name.capitalize()}Table", fields, described)
    return made | None, Field(default=None, description=described)


_Declared: Any = _model_of(
    "_Declared",
    {name: _table(name) if name in TABLES else _field(name, SURVEY[name]) for name in SURVEY},
    "The declared settings.",
)


class SurveySettings(_Declared):  # type: ignore[misc]
    """All that a survey is asked for; a setting that is None has its default.

    ``settings_file`` is a survey's TOML file on the machine that runs the flow; the other parameters win over it.
    """

    settings_file: str | None = Field(default=None, description="A survey's TOML file, on the machine that surveys")
    _settings: Settings | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def check(self) -> Self:
        """Check the settings as the command line does; its message is the parameter's."""
        try:
            self.settings()
        except PipelineError as error:
            raise ValueError(str(error)) from None
        return self

    def settings(self) -> Settings:
        """Return the checked settings (SettingsError: the first that cannot be used)."""
        if self._settings is None:
            given = self.model_dump(exclude_none=True, exclude={"settings_file"})
            flags: dict[str, object] = {}
            for name, value in given.items():
                flags |= {f"{name}.{key}": one for key, one in value.items()} if name in TABLES else {name: value}
            self._settings = load_settings(self.settings_file, flags)
        return self._settings

    @classmethod
    def of(cls, settings: Settings) -> SurveySettings:
        """Return the parameters of settings; within this process they are these very settings, passwords too."""
        table = anchor_paths(settings.to_dict(), Path.cwd())
        usual = Settings().to_dict() | {"source": AUTO}  # another machine is told which it is
        given = {name: _changed(value, usual.get(name)) for name, value in table.items() if value != usual.get(name)}
        tables = {name: _model(name).model_construct(**value) for name, value in given.items() if name in TABLES}
        made: SurveySettings = cls.model_construct(**given | tables)
        made._settings = settings
        return made

    def with_rig_of(self, file: str) -> SurveySettings:
        """Return the same with the table [rig] of another settings file (SettingsError: it cannot be used)."""
        return SurveySettings.of(replace(self.settings(), rig=load_settings(file).rig))

    @property
    def name_of_run(self) -> str:
        """Return the field's name, or its scene's."""
        asked = self.settings()
        return asked.name or Path(asked.scene).stem


def _changed(value: Any, usual: Any) -> Any:
    """Return what of a table differs from the defaults; anything else as it is."""
    if not isinstance(value, dict) or not isinstance(usual, dict):
        return value
    return {key: one for key, one in value.items() if one != usual.get(key)}


def _model(table: str) -> type[BaseModel]:
    found: type[BaseModel] = get_args(_Declared.model_fields[table].annotation)[0]
    return found


def at_due_time(settings: Settings, due: datetime) -> Settings:
    """Return the settings of a scheduled visit: named by its due time, after what the field's newest run left.

    The farm is as on that day by this machine's clock. What the settings say of visit, day and prior stays.
    """
    visit = settings.visit or due.astimezone(UTC).isoformat().replace("+00:00", "Z")
    asked = replace(settings, visit=visit, prior="latest" if settings.prior == "auto" else settings.prior)
    if asked.source == "sim" and asked.scene in BUILT_IN_SCENES and asked.day is None:
        return replace(asked, day=due.astimezone().timetuple().tm_yday)
    return asked
