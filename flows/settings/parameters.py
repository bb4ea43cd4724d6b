"""Define the parameters of the survey flow from the declared settings, for Prefect's form and validation."""

from __future__ import annotations

from dataclasses import MISSING
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from spectralzoom.flows.settings.documents import about, toml_value
from spectralzoom.flows.settings.load import SURVEY, TABLES, Declared, anchor_paths, load_settings
from spectralzoom.flows.settings.survey_settings import AUTO, Settings
from spectralzoom.pipeline.errors import PipelineError, SettingsError

OF_LISTS = {"bands": "integer", "wavelengths": "number", "size": "integer"}  # also as text: 0-3,7
SECRET = "password"  # only from a settings file, since a server stores parameters
KINDS = {bool: "boolean", int: "integer", float: "number", str: "string"}


def _schema(schema: dict[str, Any]) -> None:
    """Add the type, choices, default and help of every setting to the schema of the parameters."""
    schema["additionalProperties"] = False
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
    usual = "" if default is None or default is MISSING else f"; {toml_value(one)} by default"
    kind: dict[str, Any] = {"type": KINDS.get(one.kind, ["string", "number"])}  # such as 0.5 or 50%
    if one.choices:
        kind = {"enum": list(one.choices)}
    elif name in OF_LISTS:
        kind = {"anyOf": [{"type": "array", "items": {"type": OF_LISTS[name]}}, {"type": "string"}]}
    return {"title": name.replace("_", " "), "description": about(one, choices=False) + usual, **kind}


class SurveySettings(BaseModel):
    """Settings of a survey, with the names of the settings file; all have defaults.

    ``settings_file`` is a TOML file on the machine that runs the flow; the other parameters override it.
    """

    model_config = ConfigDict(extra="allow", protected_namespaces=(), json_schema_extra=_schema)

    settings_file: str | None = Field(
        default=None, description="Settings file (TOML) on the machine that runs the flow"
    )
    _settings: Settings | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def check(self) -> Self:
        """Check the settings as the command line does, with the same messages."""
        try:
            self.settings()
        except PipelineError as error:
            raise ValueError(str(error)) from None
        return self

    def settings(self) -> Settings:
        """Return the checked settings. Raises SettingsError: the first that is not allowed."""
        if self._settings is None:
            flags: dict[str, object] = {}
            for name, value in (self.model_extra or {}).items():
                table = value if name in TABLES and isinstance(value, dict) else None
                flags |= {name: value} if table is None else {f"{name}.{key}": one for key, one in table.items()}
            if flags.get(f"rig.{SECRET}") is not None:
                raise SettingsError(
                    f"rig.{SECRET} is not allowed as a parameter, since a server stores it; write it into settings_file"
                )
            self._settings = load_settings(self.settings_file, flags)
        return self._settings

    @classmethod
    def of(cls, settings: Settings) -> SurveySettings:
        """Return settings as parameters; within this process they keep the password."""
        table = anchor_paths(settings.to_dict(), Path.cwd())
        usual: dict[str, Any] = Settings().to_dict() | {"source": AUTO}
        changed: dict[str, Any] = {name: value for name, value in table.items() if value != usual.get(name)}
        for name, value in changed.items():  # of a table only the keys that differ
            if isinstance(value, dict) and isinstance(usual.get(name), dict):
                changed[name] = {key: one for key, one in value.items() if one != usual[name].get(key)}
        made: SurveySettings = cls.model_construct(**changed)
        made._settings = settings
        return made
