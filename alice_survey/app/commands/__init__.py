"""The commands of `alice-survey`: the command line and the studio read their arguments here."""

from alice_survey.app.commands import camera, intake, plan, reconstruct, survey, vehicle
from alice_survey.app.commands.base import CommandModel

COMMANDS: tuple[type[CommandModel], ...] = (
    survey.InitCommand, survey.FovCommand, plan.PlanCommand, survey.FlyCommand,
    survey.ImageCommand, survey.TargetCommand, survey.CalibrateCommand,
    intake.ImportImagesCommand, intake.ImportLogCommand, intake.ImportControlCommand,
    intake.JoinCommand, reconstruct.ReconstructCommand, reconstruct.ControlCommand,
    reconstruct.MeasureCommand, reconstruct.QualityCommand, reconstruct.EvaluateCommand,
    reconstruct.MosaicTilesCommand, survey.ReportPageCommand, survey.RunCommand,
    survey.DemoCommand, survey.StatusCommand, vehicle.PilotCommand,
    plan.SolveCommand, plan.PrecisionCommand, plan.GainCommand, plan.CheckCommand,
    plan.FollowCommand, plan.RevisitCommand, plan.ExportCommand,
    camera.CameraCommand, camera.ConvertCommand, camera.UncertaintyCommand,
    vehicle.CoefficientsCommand, vehicle.CompareCommand,
    vehicle.IdentifyCommand,
)  # fmt: skip
