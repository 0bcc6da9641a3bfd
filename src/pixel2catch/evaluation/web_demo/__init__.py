"""A page that runs a policy in a browser, without an installation."""

from pixel2catch.evaluation.web_demo.export import write_web_demo as write_web_demo
