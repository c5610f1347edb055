"""ToolFiles of annotation tools: one module each, read and written."""
