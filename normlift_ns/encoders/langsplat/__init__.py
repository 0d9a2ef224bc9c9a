"""Regions and features in the files of LangSplat's preprocessing."""
