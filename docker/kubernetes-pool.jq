# Prefect's base job template of a kubernetes pool -> ours: volume claims `photos` and `runs`, no root, nothing written
# to the image. docs/operations.md has the command. For the pool of a GPU's worker add, behind securityContext below:
#   resources: {limits: {"nvidia.com/gpu": 1}}
.job_configuration.job_manifest.spec.template.spec |= (
  . + {
    securityContext: {runAsNonRoot: true, runAsUser: 10001, runAsGroup: 10001, fsGroup: 10001},
    volumes: [
      {name: "photos", persistentVolumeClaim: {claimName: "photos", readOnly: true}},
      {name: "runs", persistentVolumeClaim: {claimName: "runs"}},
      {name: "tmp", emptyDir: {}}
    ]
  }
  | .containers[0] += {
    securityContext: {readOnlyRootFilesystem: true, allowPrivilegeEscalation: false, capabilities: {drop: ["ALL"]}},
    volumeMounts: [
      {name: "photos", mountPath: "/photos", readOnly: true},
      {name: "runs", mountPath: "/runs"},
      {name: "tmp", mountPath: "/tmp"}
    ]
  }
)
