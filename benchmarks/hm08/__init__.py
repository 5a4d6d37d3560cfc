"""Parts of benchmarks.build_template: from MakeHuman's hm08 base mesh to the project's head template."""
