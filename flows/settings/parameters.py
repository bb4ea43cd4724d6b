"""A survey's settings as the parameters of a flow: the declared settings, for Prefect's form and checks."""

from __future__ import annotations

from dataclasses import MISSING, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from flows.settings.documents import about, shown
from flows.settings.load import SURVEY, TABLES, Declared, anchor_paths, load_settings
from flows.settings.survey_settings import AUTO, BUILT_IN_SCENES, Settings
from pipeline.errors import PipelineError, SettingsError

OF_LISTS = {"bands": "integer", "wavelengths": "number", "size": "integer"}  # also as text: 0-3,7
SECRET = "password"  # is read from the settings file alone: a server keeps parameters
KINDS = {bool: "boolean", int: "integer", float: "number", str: "string"}


def _schema(schema: dict[str, Any]) -> None:
    """Add every declared setting to the schema of the parameters: type, choices, default and line of help."""
    schema["additionalProperties"] = False  # a server refuses what is no setting
    for name, one in SURVEY.items():
        schema["properties"][name] = (
            {
                "title": name.replace("_", " "),
                "type": "object",
                "description": one.item.metadata["description"],
                "properties": {key: _described(key, inner) for key, inner in TABLES[name].items() if key != SECRET},
                "additionalProperties": False,
            }
            if name in TABLES
            else _described(name, one)
        )


def _described(name: str, one: Declared) -> dict[str, Any]:
    default = one.item.default
    usual = "" if default is None or default is MISSING else f"; {shown(one)} by default"
    kind: dict[str, Any] = {"type": KINDS.get(one.kind, ["string", "number"])}  # such as 0.5 or 50%
    if one.choices:
        kind = {"enum": list(one.choices)}
    elif name in OF_LISTS:
        kind = {"anyOf": [{"type": "array", "items": {"type": OF_LISTS[name]}}, {"type": "string"}]}
    return {"title": name.replace("_", " "), "description": about(one, choices=False) + usual, **kind}


class SurveySettings(BaseModel):
    """All that a survey is asked for, by the names of the settings file; what is left out has its default.

    ``settings_file`` is a survey's TOML file on the machine that runs the flow; the other parameters win over it.
    """

    model_config = ConfigDict(extra="allow", protected_namespaces=(), json_schema_extra=_schema)

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
            flags: dict[str, object] = {}
            for name, value in (self.model_extra or {}).items():
                table = value if name in TABLES and isinstance(value, dict) else None
                flags |= {name: value} if table is None else {f"{name}.{key}": one for key, one in table.items()}
            if flags.get(f"rig.{SECRET}") is not None:
                raise SettingsError(f"rig.{SECRET} is no parameter, which a server keeps: write it into settings_file")
            self._settings = load_settings(self.settings_file, flags)
        return self._settings

    @classmethod
    def of(cls, settings: Settings) -> SurveySettings:
        """Return the parameters of settings; within this process they are these very settings, passwords too."""
        table = anchor_paths(settings.to_dict(), Path.cwd())
        usual = Settings().to_dict() | {"source": AUTO}  # another machine needs its name
        given = {name: _changed(value, usual.get(name)) for name, value in table.items() if value != usual.get(name)}
        made: SurveySettings = cls.model_construct(**given)
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


def at_due_time(settings: Settings, due: datetime) -> Settings:
    """Return the settings of a scheduled visit: named by its due time, after what the field's newest run left.

    The farm is as on that day by this machine's clock. What the settings say of visit, day and prior stays.
    """
    visit = settings.visit or due.astimezone(UTC).isoformat().replace("+00:00", "Z")
    asked = replace(settings, visit=visit, prior="latest" if settings.prior == "auto" else settings.prior)
    if asked.source == "sim" and asked.scene in BUILT_IN_SCENES and asked.day is None:
        return replace(asked, day=due.astimezone().timetuple().tm_yday)
    return asked
