"""The commands of `alice-survey`: the command line and the studio read their arguments here."""

from alice_survey.app.commands import camera, missions, pictures, survey
from alice_survey.app.commands.base import CommandModel

COMMANDS: tuple[type[CommandModel], ...] = (
    survey.InitCommand, survey.FovCommand, missions.PlanCommand, survey.FlyCommand,
    survey.ImageCommand, survey.TargetCommand, survey.CalibrateCommand,
    pictures.ImportImagesCommand, pictures.ImportLogCommand, pictures.ImportControlCommand,
    pictures.JoinCommand, pictures.ReconstructCommand, pictures.ControlCommand,
    pictures.MeasureCommand, pictures.QualityCommand, pictures.EvaluateCommand,
    pictures.MosaicTilesCommand, survey.ReportPageCommand, survey.RunCommand,
    survey.DemoCommand, survey.StatusCommand, missions.PilotCommand,
    missions.SolveCommand, missions.PrecisionCommand, missions.GainCommand, missions.CheckCommand,
    missions.FollowCommand, missions.RevisitCommand, missions.ExportCommand,
    camera.CameraCommand, camera.ConvertCommand, camera.UncertaintyCommand,
    missions.CoefficientsCommand, missions.CompareCommand,
    missions.IdentifyCommand,
)  # fmt: skip
